// Recordings: stepped through, and looked at with two settings side by side.

import { answerWords, ask, byId, coalesced, kindWords, make, setText } from "./dom.js";
import { drawScene, layerSwitches } from "./scene.js";
import { makeInput, read, same, shown, write } from "./settings.js";

const POLL_MS = 400;
const COMPARED = ["detector.", "camera."];
const NOT_COMPARED = ["deadline_s", "start_timeout_s", "restart_delay_s", "restart_delay_max_s", "send_obstacle_distance", "threads"];
const KINDS = ["vanishing_point", "lowest_flow", "gap", "single_plane", "none"];

export class RecordingsView {
  constructor(settings) {
    this.settings = settings;
    this.recording = null;
    this.at = 0;
    this.bitmap = null;
    this.asked = 0;
    this.rows = new Map();
    this.comparison = null;
    this.lanes = [];
    this.playing = false;
    this.draw = coalesced(() => this.paint());
    this.layers = layerSwitches(byId("lane-layers"), { live: false, remember: "layers-recordings", changed: () => this.draw() });
    byId("scrub").addEventListener("input", () => this.goTo(Number(byId("scrub").value)));
    for (const [id, step] of [["step-first", -Infinity], ["step-back", -1], ["step-on", 1], ["step-last", Infinity]]) {
      byId(id).addEventListener("click", () => {
        this.pause();
        this.goTo(this.at + step);
      });
    }
    byId("play").addEventListener("click", () => (this.playing ? this.pause() : this.play()));
    byId("player-card").addEventListener("keydown", (event) => {
      if (event.target.matches("input, select, button")) return;
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (step) this.goTo(this.at + step);
    });
    byId("add-a").addEventListener("click", () => this.addTry("a"));
    byId("add-b").addEventListener("click", () => this.addTry("b"));
    byId("try-start").addEventListener("click", () => this.compare());
    byId("try-stop").addEventListener("click", () => this.stop());
    new ResizeObserver(this.draw).observe(byId("view-recordings"));
  }

  async show() {
    if (this.recording) return;
    try {
      const { recordings } = await ask("/api/recordings");
      byId("recording-none").hidden = recordings.length > 0;
      byId("recording-list").replaceChildren(
        ...recordings.map((one) => make("li", {}, make("button", { class: "recording", "data-id": one.id, onclick: () => this.open(one.id) }, make("span", { class: "recording-name" }, one.name), make("span", { class: "muted" }, `${one.kind}, ${when(one.modified)}`)))),
      );
      if (recordings.length === 1) await this.open(recordings[0].id);
    } catch (error) {
      byId("recording-none").hidden = false;
      setText(byId("recording-none"), error.message);
    }
  }

  redraw() {
    this.draw();
  }

  async open(id) {
    this.pause();
    await this.stop();
    let about;
    try {
      about = await ask(`/api/recordings/${encodeURIComponent(id)}`);
    } catch (error) {
      byId("recording-none").hidden = false;
      setText(byId("recording-none"), error.message);
      return;
    }
    byId("recording-none").hidden = true;
    for (const button of byId("recording-list").querySelectorAll("button")) button.setAttribute("aria-current", String(button.dataset.id === id));
    this.recording = about;
    this.rows = new Map();
    this.bitmap = null;
    const last = about.pictures - 1;
    byId("player-card").hidden = byId("compare-card").hidden = false;
    setText(byId("player-title"), about.name);
    setText(byId("player-facts"), `${about.pictures} pictures, ${about.times_s[last].toFixed(1)} s, ${about.width_px} × ${about.height_px} px, ${about.has_poses ? "with poses" : "without poses"}`);
    byId("scrub").max = byId("try-first").max = byId("try-last").max = last;
    byId("try-first").value = 0;
    byId("try-last").value = Math.min(last, 99);
    byId("try-table").hidden = true;
    setText(byId("try-message"), about.has_poses ? "" : "Without poses there are no metres: answers of the paper's method, no void map.");
    this.makeLanes(1);
    this.goTo(0);
    await this.settings.loaded();
    if (!byId("try-b").children.length) {
      const method = this.settings.entries.get("detector.method");
      this.addTry("b", "detector.method", method && method.value === "paper" ? "parallax" : "paper");
    }
  }

  makeLanes(count) {
    this.lanes = Array.from({ length: count }, (_, at) => {
      const name = count > 1 ? "AB"[at] : "";
      const canvas = make("canvas", { class: "lane-picture", role: "img", "aria-label": `Picture${name ? ` of ${name}` : ""}` });
      const words = make("p", { class: "lane-words" });
      const box = make("figure", { class: "lane" }, make("div", { class: "picture-frame" }, canvas), make("figcaption", {}, name ? make("b", { class: "lane-name" }, name) : null, words));
      return { box, canvas, words };
    });
    byId("lanes").replaceChildren(...this.lanes.map((lane) => lane.box));
    byId("lanes").classList.toggle("two", count > 1);
    this.strips = count > 1 || this.rows.size ? this.lanes.map((_, at) => make("canvas", { class: "strip", role: "img", "aria-label": `Answers${count > 1 ? ` of ${"AB"[at]}` : ""} over time` })) : [];
    byId("player-strips").replaceChildren(...this.strips);
  }

  goTo(wanted) {
    if (!this.recording) return;
    this.at = Math.max(0, Math.min(this.recording.pictures - 1, wanted));
    byId("scrub").value = this.at;
    byId("scrub").setAttribute("aria-valuetext", `picture ${this.at}`);
    setText(byId("player-time"), `${this.at + 1} / ${this.recording.pictures}   ${this.recording.times_s[this.at].toFixed(2)} s`);
    this.load();
  }

  /** Load the picture that is wanted now; of several that are asked for meanwhile, the newest. */
  async load() {
    if (this.loading) {
      this.again = true;
      return;
    }
    this.loading = true;
    do {
      this.again = false;
      const at = this.at;
      try {
        const response = await fetch(`/api/recordings/${this.recording.id}/pictures/${at}.jpg`);
        if (!response.ok) throw new Error((await response.json()).error);
        this.bitmap = await createImageBitmap(await response.blob());
        this.bitmapAt = at;
      } catch (error) {
        this.bitmap = null;
        setText(byId("try-message"), error.message);
      }
      this.draw();
    } while (this.again);
    this.loading = false;
  }

  paint() {
    if (!this.recording || byId("view-recordings").hidden) return;
    const row = this.rows.get(this.bitmapAt);
    const size = [this.recording.width_px, this.recording.height_px];
    const methods = new Set();
    this.lanes.forEach((lane, at) => {
      const seen = row && row.lanes[at];
      if (seen && seen.details.method) methods.add(seen.details.method);
      drawScene(lane.canvas, { bitmap: this.bitmap, size, detection: seen && seen.detection, details: seen && seen.details, layers: this.layers.on });
      const words = seen ? `${answerWords(seen.detection)}${Number.isFinite(seen.detection.confidence) ? `, confidence ${seen.detection.confidence.toFixed(2)}` : ""}, ${Math.round(1000 * seen.detection.detector_s)} ms` : this.rows.size ? "not looked at" : "";
      setText(lane.words, words);
      lane.canvas.setAttribute("aria-label", `Picture ${this.at}${this.lanes.length > 1 ? ` with ${"AB"[at]}` : ""}: ${words || "as recorded"}`);
      lane.canvas.dataset.picture = this.bitmapAt ?? "";
    });
    this.layers.forMethods(methods);
    this.strips.forEach((canvas, at) => this.paintStrip(canvas, at));
  }

  paintStrip(canvas, lane) {
    const ratio = Math.min(window.devicePixelRatio || 1, 2);
    canvas.width = Math.round(canvas.clientWidth * ratio);
    canvas.height = Math.round(canvas.clientHeight * ratio);
    const context = canvas.getContext("2d");
    const style = getComputedStyle(document.documentElement);
    const step = canvas.width / this.recording.pictures;
    context.fillStyle = style.getPropertyValue("--well");
    context.fillRect(0, 0, canvas.width, canvas.height);
    for (const [number, row] of this.rows) {
      const seen = row.lanes[lane];
      if (!seen) continue;
      context.fillStyle = style.getPropertyValue(`--kind-${seen.detection.kind.replace("_", "-")}`);
      context.fillRect(number * step, 0, Math.max(1, step + 0.5), canvas.height);
    }
    context.fillStyle = style.getPropertyValue("--text");
    context.fillRect(this.at * step - ratio, 0, 2 * ratio, canvas.height);
  }

  play() {
    if (!this.recording) return;
    this.playing = true;
    setText(byId("play"), "❚❚");
    byId("play").setAttribute("aria-label", "Pause");
    if (this.at >= this.recording.pictures - 1) this.goTo(0);
    const start = { wall: performance.now(), time: this.recording.times_s[this.at] };
    this.timer = setInterval(() => {
      const time = start.time + (performance.now() - start.wall) / 1000;
      let at = this.at;
      while (at + 1 < this.recording.pictures && this.recording.times_s[at + 1] <= time) at += 1;
      if (at !== this.at) this.goTo(at);
      if (at >= this.recording.pictures - 1) this.pause();
    }, 30);
  }

  pause() {
    clearInterval(this.timer);
    this.playing = false;
    setText(byId("play"), "▶\uFE0E");
    byId("play").setAttribute("aria-label", "Play");
  }

  /** Add a setting to one of the two sides. */
  addTry(side, key, value) {
    const entries = [...this.settings.entries.values()].filter((entry) => COMPARED.some((start) => entry.key.startsWith(start)) && !NOT_COMPARED.includes(entry.name));
    if (!entries.length) return;
    const box = byId(`try-${side}`);
    const choose = make("select", { "aria-label": `Setting of ${side.toUpperCase()}` }, ...entries.map((entry) => make("option", { value: entry.key }, entry.key)));
    const place = make("span", { class: "try-value" });
    const row = make("div", { class: "try-row" }, choose, place, make("button", { class: "quiet", "aria-label": "Remove", onclick: () => row.remove() }, "×"));
    const showInput = (given) => {
      const entry = this.settings.entries.get(choose.value);
      const input = makeInput(entry, "");
      input.removeAttribute("id");
      input.setAttribute("aria-label", `${entry.key} of ${side.toUpperCase()}`);
      write(input, entry.type, given ?? entry.value);
      place.replaceChildren(input, entry.unit ? make("span", { class: "muted" }, entry.unit) : "");
    };
    choose.addEventListener("change", () => showInput());
    if (key) choose.value = key;
    showInput(value);
    box.append(row);
  }

  values(side) {
    const found = {};
    for (const row of byId(`try-${side}`).children) {
      const entry = this.settings.entries.get(row.querySelector("select").value);
      const value = read(row.querySelector(".try-value").firstChild, entry.type);
      if (value === undefined) throw new Error(`${entry.key}: allowed is ${entry.allowed}`);
      if (!same(value, entry.value)) found[entry.key] = value;
    }
    return found;
  }

  async compare() {
    await this.stop();
    const message = byId("try-message");
    message.classList.remove("error");
    try {
      const sides = [this.values("a"), this.values("b")];
      if (same(sides[0], sides[1])) throw new Error("A and B are the same: change a setting of one of them");
      const first = Number(byId("try-first").value);
      const last = Number(byId("try-last").value);
      setText(message, "starting ...");
      const { number } = await ask("/api/comparisons", { recording: this.recording.id, first, last, settings: sides });
      this.comparison = { number, first, last, sides };
    } catch (error) {
      message.classList.add("error");
      setText(message, error.message);
      return;
    }
    this.rows = new Map();
    this.makeLanes(2);
    this.goTo(this.comparison.first);
    byId("try-progress").hidden = byId("try-stop").hidden = false;
    this.poll(this.comparison);
  }

  async poll(comparison) {
    let after = 0;
    while (this.comparison === comparison) {
      let answer;
      try {
        answer = await ask(`/api/comparisons/${comparison.number}?after=${after}`);
      } catch (error) {
        answer = { rows: [], done: true, error: error.message };
      }
      if (this.comparison !== comparison) return;
      after += answer.rows.length;
      for (const row of answer.rows) this.rows.set(row.number, row);
      if (answer.rows.length && !this.playing && this.at === answer.rows[0].number - 1) this.goTo(answer.rows[answer.rows.length - 1].number);
      const total = comparison.last - comparison.first + 1;
      byId("try-progress").value = after / total;
      setText(byId("try-message"), answer.error || (answer.done ? `looked at ${after} pictures` : `${after} of ${total} pictures`));
      this.showFigures(comparison);
      this.draw();
      if (answer.done) {
        byId("try-progress").hidden = byId("try-stop").hidden = true;
        byId("try-message").classList.toggle("error", Boolean(answer.error));
        return;
      }
      if (!answer.rows.length) await new Promise((resolve) => setTimeout(resolve, POLL_MS));
    }
  }

  async stop() {
    const { comparison } = this;
    this.comparison = null;
    byId("try-progress").hidden = byId("try-stop").hidden = true;
    if (comparison) await ask(`/api/comparisons/${comparison.number}`, undefined, "DELETE").catch(() => {});
  }

  showFigures(comparison) {
    const rows = [...this.rows.values()].filter((row) => row.lanes.every(Boolean));
    if (!rows.length) return;
    const lane = (at) => rows.map((row) => row.lanes[at].detection);
    const both = [lane(0), lane(1)];
    const lines = KINDS.filter((kind) => both.some((list) => list.some((one) => one.kind === kind))).map((kind) => [kindWords(kind), ...both.map((list) => String(list.filter((one) => one.kind === kind).length)), kind]);
    const median = (list) => (list.length ? [...list].sort((a, b) => a - b)[Math.floor(list.length / 2)] : NaN);
    const figure = (name, pick, digits, unit) => [name, ...both.map((list) => {
      const value = median(list.map(pick).filter(Number.isFinite));
      return Number.isFinite(value) ? `${value.toFixed(digits)} ${unit}`.trim() : "–";
    })];
    lines.push(figure("distance, median", (one) => one.distance_m, 2, "m"), figure("confidence, median", (one) => one.confidence, 2, ""), figure("time, median", (one) => 1000 * one.detector_s, 0, "ms"));
    const pointed = rows.filter((row) => row.lanes.every((one) => Number.isFinite(one.detection.x_px)));
    const apart = median(pointed.map((row) => Math.abs(row.lanes[0].detection.x_px - row.lanes[1].detection.x_px)));
    const alike = rows.filter((row) => row.lanes[0].detection.kind === row.lanes[1].detection.kind).length;
    const names = comparison.sides.map((values) => Object.entries(values).map(([key, value]) => `${key} = ${shown(value)}`).join(", ") || "as they are");
    byId("try-table").replaceChildren(
      make("table", {}, make("thead", {}, make("tr", {}, make("td", {}), ...names.map((name, at) => make("th", { scope: "col" }, `${"AB"[at]}: ${name}`)))),
        make("tbody", {}, ...lines.map(([name, a, b, kind]) => {
          const mark = kind ? make("span", { class: `kind-mark kind-${kind.replace("_", "-")}` }) : null;
          return make("tr", {}, make("th", { scope: "row" }, mark, name), make("td", {}, a), make("td", {}, b));
        }))),
      make("p", { class: "muted" }, `The same kind of answer on ${alike} of ${rows.length} pictures${Number.isFinite(apart) ? `; where both point somewhere, ${apart.toFixed(0)} px apart in the middle` : ""}.`),
    );
    byId("try-table").hidden = false;
  }
}

function when(seconds) {
  return new Date(1000 * seconds).toLocaleString(undefined, { dateStyle: "medium", timeStyle: "short" });
}
