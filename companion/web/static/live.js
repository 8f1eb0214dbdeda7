// The live view.

import { answerWords, byId, coalesced, facts, kindWords, make, number, setText } from "./dom.js";
import { drawHistory, Plots, stateColour } from "./plots.js";
import { drawScene, layerSwitches } from "./scene.js";
import { TopView } from "./topview.js";

const LEVELS = { debug: 0, info: 1, warning: 2, warn: 2, error: 3, critical: 3, exception: 3 };
const STALE_S = 2;

export class LiveView {
  constructor(connection) {
    this.connection = connection;
    this.picture = null;
    this.pictureTimes = [];
    this.states = "";
    this.open = false;
    this.map = new TopView(byId("map"));
    this.plots = new Plots(byId("plots"));
    this.layers = layerSwitches(byId("layers"), {
      live: true,
      remember: "layers-live",
      changed: () => {
        connection.want(this.layers.needsDetails());
        this.drawPicture();
      },
    });
    connection.details = this.layers.needsDetails();
    this.drawPicture = coalesced(() => this.paintPicture());
    this.drawMap = coalesced(() => this.paintMap());
    connection.addEventListener("picture", (event) => this.takePicture(event.detail));
    connection.addEventListener("state", (event) => this.take(event.detail));
    byId("map-in").addEventListener("click", () => this.zoom(1 / 1.4));
    byId("map-out").addEventListener("click", () => this.zoom(1.4));
    byId("log-level").addEventListener("change", () => this.showLog(true));
    new ResizeObserver(() => {
      this.drawPicture();
      this.drawMap();
    }).observe(byId("view-live"));
    setInterval(() => this.tick(), 500);
  }

  redraw() {
    this.drawPicture();
    this.drawMap();
    this.tick();
  }

  zoom(factor) {
    this.map.zoom(factor);
    this.drawMap();
  }

  takePicture(header) {
    if (this.picture) this.picture.bitmap.close();
    this.picture = header;
    this.pictureTimes.push(performance.now());
    while (this.pictureTimes.length && performance.now() - this.pictureTimes[0] > 2000) this.pictureTimes.shift();
    byId("picture-none").hidden = true;
    byId("picture").dataset.seq = header.seq;
    this.drawPicture();
  }

  take(message) {
    const latest = message.latest;
    const lists = message.appended || {};
    if (latest.switch || lists.states || message.type === "snapshot") this.showState();
    if (latest.detection || latest.details || latest.setpoint) this.drawPicture();
    if (latest.details) this.layers.forMethods(new Set([latest.details.method]));
    if (latest.detection) this.showAnswer(latest.detection);
    if (latest.pose || latest.detection || latest.setpoint || latest.details || lists.trail) this.drawMap();
    if (latest.status || latest.links || latest.viewers) this.showStatus();
    if (lists.log || message.type === "snapshot") this.showLog(message.type === "snapshot", lists.log || []);
  }

  /** Details belong to the answer that they lead to; without a newer one they are shown on. */
  fresh(name, seconds = STALE_S) {
    const value = this.connection.latest[name];
    return value && this.connection.now() - value.t < seconds ? value : null;
  }

  paintPicture() {
    if (byId("view-live").hidden || !this.picture) return;
    const { picture } = this;
    const setpoint = this.fresh("setpoint");
    drawScene(byId("picture"), {
      bitmap: picture.bitmap,
      size: [picture.width_px, picture.height_px],
      detection: this.fresh("detection"),
      details: this.fresh("details"),
      planner: setpoint && setpoint.goal_px,
      layers: this.layers.on,
    });
  }

  paintMap() {
    if (byId("view-live").hidden) return;
    this.map.draw({ pose: this.connection.latest.pose, trail: this.connection.lists.trail, setpoint: this.fresh("setpoint"), detection: this.fresh("detection", 10), details: this.fresh("details", 10) });
  }

  tick() {
    if (byId("view-live").hidden) return;
    const now = this.connection.now();
    this.plots.draw(this.connection.lists.series, now);
    drawHistory(byId("history"), this.connection.lists.states, now);
    const current = this.connection.latest.switch;
    setText(byId("state-since"), current && now ? `for ${duration(now - current.t)}` : "");
    const rate = this.pictureTimes.filter((time) => performance.now() - time < 2000).length / 2;
    const stale = this.picture && (!this.open || rate === 0);
    byId("picture").classList.toggle("stale", Boolean(stale));
    setText(byId("picture-note"), !this.picture ? "" : stale ? "the picture stands still" : `${rate.toFixed(0)} pictures/s`);
    this.showAges();
  }

  showState() {
    const current = this.connection.latest.switch;
    if (!current) return;
    setText(byId("state-name"), current.state || "–");
    setText(byId("state-reason"), current.reason || "");
    byId("state-card").style.setProperty("--state", stateColour(current.state));
    const said = `${current.state}: ${current.reason}`;
    if (said !== this.states) {
      this.states = said;
      setText(byId("state-live"), said);
      document.title = `${current.state} · Void companion`;
    }
    const changes = this.connection.lists.states.slice(-6).reverse();
    byId("state-list").replaceChildren(
      ...changes.map((change) => {
        const mark = make("span", { class: "state-mark" });
        mark.style.background = stateColour(change.state);
        return make("li", { "data-t": change.t }, mark, make("b", {}, change.state), make("span", {}, change.reason || ""), make("span", { class: "muted ago" }));
      }),
    );
    this.showAges();
  }

  showAges() {
    const now = this.connection.now();
    for (const entry of byId("state-list").children) setText(entry.lastChild, now ? `${duration(now - Number(entry.dataset.t))} ago` : "");
  }

  showAnswer(detection) {
    const words = answerWords(detection);
    setText(byId("answer-words"), words);
    byId("picture").setAttribute("aria-label", `Camera picture, ${words}`);
    const details = this.connection.latest.details;
    const counts = (details && details.method === "paper" && details.counts) || {};
    facts(byId("answer-facts"), [
      ["kind", kindWords(detection.kind)],
      ["distance", Number.isFinite(detection.distance_m) ? `${detection.distance_m.toFixed(2)} ± ${(detection.distance_spread_m ?? 0).toFixed(2)} m` : null],
      ["confidence", number(detection.confidence, 2)],
      ["baseline", number(detection.baseline_m, 2, "m")],
      ["took", Number.isFinite(detection.detector_s) ? `${Math.round(1000 * detection.detector_s)} ms` : null],
      ["flow kept", counts.n_tracks ? `${counts.n_after_angle} of ${counts.n_tracks}` : null],
      ["frame", detection.frame_seq],
    ]);
  }

  showStatus() {
    const { status = {}, links: known = {}, setpoint, pose, viewers } = this.connection.latest;
    const links = status.links || {};
    const names = [...new Set([...Object.keys(known), ...Object.keys(links)])];
    byId("links").replaceChildren(
      ...names.map((name) => {
        const link = { ...known[name], ...links[name] };
        const good = link.state === "open" || link.state === "connected";
        return make("tr", {}, make("th", { scope: "row", title: link.url || "" }, name.replace(/^link\./, "")), make("td", { class: good ? "good" : "bad" }, link.state || "–"), make("td", {}, bytes(link.received_bytes)), make("td", {}, bytes(link.sent_bytes)), make("td", {}, String((link.drops || 0) + (link.sequence_gaps || 0))));
      }),
    );
    facts(byId("vehicle-facts"), [
      ["protected", status.engaged === undefined ? null : status.engaged ? "yes" : "no"],
      ["armed", status.armed === undefined ? null : status.armed ? "yes" : "no"],
      ["missing", status.not_ready],
      ["worker", status.worker && `${status.worker}${status.worker_restarts ? `, ${status.worker_restarts} restarts` : ""}`],
      ["planner", setpoint && setpoint.planner],
      ["setpoints", setpoint && setpoint.action && `${setpoint.action}${setpoint.dropped ? `: ${setpoint.dropped}` : ""}`],
      ["heading", pose && number(pose.heading_deg, 0, "°")],
      ["speed", pose && number(pose.speed_m_s, 2, "m/s")],
      ["height", pose && number(-pose.ned_m[2], 2, "m")],
      ["clock round trip", number(status.clock_round_trip_ms, 1, "ms")],
      ["viewers", viewers],
    ]);
  }

  showLog(all, lines = []) {
    const box = byId("log");
    const least = Number(byId("log-level").value);
    const follows = box.scrollHeight - box.scrollTop - box.clientHeight < 30;
    const entries = all ? this.connection.lists.log : lines;
    const shown = entries.filter((line) => (LEVELS[line.level] ?? 1) >= least).map(logLine);
    if (all) box.replaceChildren(...shown);
    else box.append(...shown);
    while (box.children.length > 200) box.firstChild.remove();
    if (follows || all) box.scrollTop = box.scrollHeight;
  }
}

function logLine(line) {
  const time = /T(\d\d:\d\d:\d\d)/.exec(line.time);
  return make("div", { class: `log-line level-${line.level}` }, make("span", { class: "log-time" }, time ? time[1] : ""), make("span", { class: "log-event" }, line.event), make("span", { class: "log-text" }, line.text));
}

function bytes(count) {
  if (!Number.isFinite(count)) return "–";
  return count < 10_000 ? `${count} B` : count < 10_000_000 ? `${Math.round(count / 1000)} kB` : `${Math.round(count / 1e6)} MB`;
}

export function duration(seconds) {
  const whole = Math.max(0, Math.round(seconds));
  return whole < 60 ? `${whole} s` : whole < 3600 ? `${Math.floor(whole / 60)} min ${whole % 60} s` : `${Math.floor(whole / 3600)} h ${Math.floor((whole % 3600) / 60)} min`;
}
