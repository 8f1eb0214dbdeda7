// Settings: a form made from the configuration's own description, with apply, undo, comparison and saving.

import { ask, byId, make, setText } from "./dom.js";

const WHEN_WORDS = { "at once": "at once", "new worker": "with a new worker: some seconds without answers", restart: "after a restart" };

export class SettingsView {
  constructor(connection, isLive) {
    this.isLive = isLive;
    this.form = null;
    this.staged = new Map();
    this.rows = new Map();
    this.entries = new Map();
    this.configSeq = undefined;
    byId("settings-search").addEventListener("input", () => this.filter());
    byId("settings-live-only").addEventListener("change", () => this.filter());
    byId("settings-apply").addEventListener("click", () => this.apply());
    byId("settings-undo").addEventListener("click", () => this.undo());
    byId("settings-discard").addEventListener("click", () => this.discard());
    byId("settings-compare").addEventListener("click", () => this.compare());
    byId("compare-close").addEventListener("click", () => byId("compare").close());
    byId("compare").addEventListener("close", () => byId("compare-rows").replaceChildren());
    byId("compare-look").addEventListener("click", () => this.save(true));
    byId("compare-save").addEventListener("click", () => this.save(false));
    byId("settings-apply").hidden = byId("settings-undo").hidden = !isLive;
    connection.addEventListener("state", (event) => {
      const seq = event.detail.latest.config_seq;
      if (seq !== undefined && seq !== this.configSeq) {
        this.configSeq = seq;
        if (this.form) this.load();
      }
    });
  }

  async show() {
    if (!this.form) await this.load();
  }

  redraw() {}

  /** The form as the server has it; asked for once. */
  async loaded() {
    if (!this.form) await this.load();
    return this.form;
  }

  async load() {
    try {
      this.form = await ask("/api/settings");
    } catch (error) {
      this.say(error.message, true);
      return;
    }
    this.entries = new Map(this.form.sections.flatMap((section) => section.keys.map((entry) => [entry.key, entry])));
    if (!this.rows.size) this.build();
    for (const [key, row] of this.rows) this.showRow(this.entries.get(key), row);
    if (this.form.fault) this.say(this.form.fault, true);
    this.showBar();
  }

  build() {
    const form = byId("settings-form");
    const tables = byId("settings-tables");
    for (const section of this.form.sections) {
      const id = `table-${section.name}`;
      tables.append(make("a", { href: `#${id}`, onclick: (event) => { event.preventDefault(); byId(id).scrollIntoView({ behavior: matchMedia("(prefers-reduced-motion: reduce)").matches ? "auto" : "smooth" }); byId(id).focus({ preventScroll: true }); } }, section.name));
      const rows = section.keys.map((entry) => this.buildRow(entry));
      form.append(make("section", { class: "card table-card", id, tabIndex: -1, "aria-labelledby": `${id}-title` }, make("h2", { id: `${id}-title` }, `[${section.name}]`), make("p", { class: "muted" }, section.description), ...rows));
    }
  }

  buildRow(entry) {
    const id = `set-${entry.key.replaceAll(".", "-")}`;
    const input = makeInput(entry, id);
    input.setAttribute("aria-describedby", `${id}-help`);
    input.addEventListener("input", () => this.stage(entry.key, input));
    const state = make("span", { class: "row-state" });
    const reset = make("button", { class: "quiet small", hidden: true, onclick: () => this.unstage(entry.key) }, "as it was");
    const error = make("p", { class: "error", role: "alert" });
    const notes = [entry.allowed && `Allowed: ${entry.allowed}.`, entry.default === undefined || entry.default === null ? "" : `Default: ${shown(entry.default)}.`].filter(Boolean).join(" ");
    const reason = entry.kept_out ? "this page shows it and does not change it" : entry.when === "restart" ? `after a restart: ${entry.reason}` : WHEN_WORDS[entry.when];
    const row = make(
      "div",
      { class: "setting", "data-key": entry.key },
      make("div", { class: "setting-head" }, make("label", { for: id }, make("span", { class: "setting-name" }, entry.name), entry.unit ? make("span", { class: "muted" }, ` ${entry.unit}`) : null), make("span", { class: `badge when-${entry.when.replace(" ", "-")}` }, entry.kept_out ? "in the file alone" : entry.when)),
      make("div", { class: "setting-input" }, input, reset, state),
      make("div", { class: "setting-help", id: `${id}-help` }, make("p", {}, entry.meaning), entry.effect ? make("p", { class: "effect" }, entry.effect) : null, make("p", { class: "muted" }, `${notes} Acts ${reason}.`.replace("Acts this page", "This page"))),
      error,
    );
    this.rows.set(entry.key, { row, input, state, reset, error });
    return row;
  }

  showRow(entry, { row, input, state, reset }) {
    const staged = this.staged.has(entry.key);
    if (!staged && document.activeElement !== input) write(input, entry.type, entry.value);
    input.disabled = Boolean(entry.kept_out);
    reset.hidden = !staged;
    row.classList.toggle("staged", staged);
    const differs = entry.file !== undefined && !same(entry.value, entry.file);
    row.classList.toggle("differs", differs);
    setText(state, staged ? `acts now: ${shown(entry.value)}` : differs ? `file: ${shown(entry.file)}` : "");
  }

  stage(key, input) {
    const entry = this.entries.get(key);
    const parts = this.rows.get(key);
    const value = read(input, entry.type);
    setText(parts.error, "");
    if (value === undefined) setText(parts.error, `not ${entry.type === "integer" ? "a whole number" : "a number"}: allowed is ${entry.allowed}`);
    if (value === undefined || same(value, entry.value)) this.staged.delete(key);
    else this.staged.set(key, value);
    this.showRow(entry, parts);
    this.showBar();
  }

  unstage(key) {
    this.staged.delete(key);
    const entry = this.entries.get(key);
    const parts = this.rows.get(key);
    write(parts.input, entry.type, entry.value);
    setText(parts.error, "");
    this.showRow(entry, parts);
    this.showBar();
    parts.input.focus();
  }

  discard() {
    for (const key of [...this.staged.keys()]) this.unstage(key);
  }

  showBar() {
    const count = this.staged.size;
    const undo = this.form ? this.form.undo : [];
    const differing = [...this.entries.values()].filter((entry) => entry.file !== undefined && !same(entry.value, entry.file)).length;
    setText(byId("settings-count"), count ? `${count} changed, not applied` : differing ? `${differing} ${differing === 1 ? "differs" : "differ"} from the file` : "as in the file");
    byId("settings-apply").disabled = byId("settings-discard").disabled = !count;
    byId("settings-undo").disabled = !undo.length;
    setText(byId("settings-undo"), undo.length ? `Undo ${undo[undo.length - 1].map((key) => key.split(".")[1]).join(", ")}` : "Undo");
  }

  async apply() {
    const values = Object.fromEntries(this.staged);
    byId("settings-apply").disabled = true;
    this.say("asked the service ...");
    try {
      this.told(await ask("/api/settings/apply", { values }), values, "acts now");
    } catch (error) {
      this.say(error.message, true);
    }
    await this.load();
  }

  async undo() {
    try {
      const answer = await ask("/api/settings/undo", {});
      this.told(answer, answer.undone || {}, "as before");
    } catch (error) {
      this.say(error.message, true);
    }
    await this.load();
  }

  told(answer, values, words) {
    if (answer.accepted) {
      for (const key of Object.keys(values)) this.staged.delete(key);
      const worker = Object.keys(answer.new_worker || {}).length ? ", with a new worker" : "";
      this.say(`${Object.keys(values).join(", ")}: ${words}${worker}`);
      return;
    }
    const refused = Object.entries(answer.refused || {}).map(([key, reason]) => `${key}: not while it runs, ${reason}. Save it to the file: it acts after a restart`);
    for (const [key, reason] of Object.entries(answer.refused || {})) if (this.rows.has(key)) setText(this.rows.get(key).error, `not while it runs: ${reason}`);
    this.say([...answer.reasons, ...refused].join("; ") || "not taken", true);
  }

  compare() {
    const staged = this.staged;
    const keys = [...this.entries.values()].filter((entry) => staged.has(entry.key) || (entry.file !== undefined && !same(entry.value, entry.file)));
    setText(byId("compare-file"), this.form.file ? (this.form.saves_to === this.form.file ? `File: ${this.form.file}` : `File: ${this.form.file}. It stays as it is: saved to ${this.form.saves_to}, which is read after it and wins.`) : "The service was started without a configuration file: there is none to save to.");
    byId("compare-rows").replaceChildren(
      ...keys.map((entry) => {
        const value = staged.has(entry.key) ? staged.get(entry.key) : entry.value;
        const box = make("input", { type: "checkbox", checked: !entry.kept_out, disabled: Boolean(entry.kept_out), value: entry.key, "aria-label": `save ${entry.key}` });
        return make("tr", {}, make("td", {}, box), make("th", { scope: "row" }, entry.key), make("td", {}, shown(value), staged.has(entry.key) ? make("span", { class: "muted" }, " not applied") : null), make("td", {}, shown(entry.file), entry.origin ? null : make("span", { class: "muted" }, " default")));
      }),
    );
    byId("compare-diff").hidden = true;
    setText(byId("compare-message"), keys.length ? "" : "Nothing differs.");
    byId("compare-save").disabled = byId("compare-look").disabled = !keys.length || !this.form.file;
    byId("compare").showModal();
  }

  async save(onlyLook) {
    const values = {};
    for (const box of byId("compare-rows").querySelectorAll("input:checked")) {
      const entry = this.entries.get(box.value);
      values[entry.key] = this.staged.has(entry.key) ? this.staged.get(entry.key) : entry.value;
    }
    const message = byId("compare-message");
    message.classList.remove("error");
    let answer;
    try {
      answer = await ask("/api/settings/save", { values, revision: this.form.revision, only_look: onlyLook });
    } catch (error) {
      answer = { accepted: false, reasons: [error.message] };
    }
    if (!answer.accepted) {
      message.classList.add("error");
      setText(message, answer.reasons.join("; "));
      return;
    }
    byId("compare-diff").replaceChildren(...answer.diff.split("\n").filter(Boolean).map((line) => make("div", { class: line.startsWith("+") ? "added" : line.startsWith("-") ? "removed" : "" }, line)));
    byId("compare-diff").hidden = !answer.diff;
    if (onlyLook) {
      setText(message, answer.diff ? "This would change; comments stay." : "The file would stay as it is.");
      return;
    }
    const overruled = Object.entries(answer.overruled || {}).map(([key, place]) => `${key} is also set in ${place}, which wins`);
    setText(message, [`Saved to ${answer.file}; comments are as they were.`, ...overruled].join(" "));
    for (const key of Object.keys(values)) this.staged.delete(key);
    await this.load();
  }

  filter() {
    const wanted = byId("settings-search").value.trim().toLowerCase();
    const liveOnly = byId("settings-live-only").checked;
    for (const section of this.form ? this.form.sections : []) {
      let any = false;
      for (const entry of section.keys) {
        const found = (!liveOnly || (entry.when !== "restart" && !entry.kept_out)) && (!wanted || `${entry.key} ${entry.meaning} ${entry.effect}`.toLowerCase().includes(wanted));
        this.rows.get(entry.key).row.hidden = !found;
        any ||= found;
      }
      byId(`table-${section.name}`).hidden = !any;
    }
  }

  say(text, isError = false) {
    const note = byId("settings-note");
    note.classList.toggle("error", isError);
    setText(note, text);
  }
}

export function makeInput(entry, id) {
  if (entry.type === "choice") return make("select", { id }, ...entry.choices.map((choice) => make("option", { value: choice }, choice)));
  if (entry.type === "boolean") return make("input", { id, type: "checkbox", class: "switch", role: "switch" });
  if (entry.type === "number" || entry.type === "integer") {
    const input = make("input", { id, type: "number", step: entry.type === "integer" ? "1" : "any" });
    if (entry.minimum !== undefined) input.min = entry.minimum;
    if (entry.maximum !== undefined) input.max = entry.maximum;
    return input;
  }
  if (entry.type === "list") return make("textarea", { id, rows: 2, spellcheck: false });
  return make("input", { id, type: "text", spellcheck: false, autocomplete: "off" });
}

export function write(input, type, value) {
  if (type === "boolean") input.checked = Boolean(value);
  else if (type === "list") input.value = Array.isArray(value) ? value.join("\n") : (value ?? "");
  else input.value = value ?? "";
}

/** The value of an input; undefined where it is none. */
export function read(input, type) {
  if (type === "boolean") return input.checked;
  if (type === "number" || type === "integer") {
    const value = Number(input.value);
    return input.value.trim() === "" || !Number.isFinite(value) || (type === "integer" && !Number.isInteger(value)) ? undefined : value;
  }
  if (type === "list") {
    const lines = input.value.split("\n").map((line) => line.trim()).filter(Boolean);
    return lines.length === 1 ? lines[0] : lines;
  }
  return input.value;
}

export const same = (a, b) => JSON.stringify(a) === JSON.stringify(b);

export function shown(value) {
  if (value === undefined || value === null) return "–";
  if (value === "") return "empty";
  return typeof value === "string" ? value : JSON.stringify(value);
}
