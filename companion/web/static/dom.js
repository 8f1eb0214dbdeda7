// Small pieces that every view uses.

export const byId = (id) => document.getElementById(id);

/** Make an element: properties by name, `class` and `data-*`, `aria-*` and `for` as attributes; then its children. */
export function make(tag, properties = {}, ...children) {
  const element = document.createElement(tag);
  for (const [name, value] of Object.entries(properties)) {
    if (value === undefined || value === null) continue;
    if (name.startsWith("on")) element.addEventListener(name.slice(2), value);
    else if (name.includes("-") || name === "class" || name === "for" || name === "role") element.setAttribute(name, value);
    else element[name] = value;
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/** Write text where it has changed: screen readers and the layout are left alone otherwise. */
export function setText(element, text) {
  if (element.textContent !== text) element.textContent = text;
}

/** Fill a <dl> with names and values. */
export function facts(list, rows) {
  const wanted = rows.filter(([, value]) => value !== undefined && value !== null && value !== "");
  const signature = wanted.map(([name]) => name).join("|");
  if (list.dataset.rows !== signature) {
    list.dataset.rows = signature;
    list.replaceChildren(...wanted.map(([name]) => make("div", {}, make("dt", {}, name), make("dd"))));
  }
  wanted.forEach(([, value], at) => setText(list.children[at].lastChild, String(value)));
}

/** The colour that a custom property of the page has now. */
export function colour(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(name).trim();
}

/** Give a canvas the pixels that it covers; returns its context, scaled to CSS pixels, and its size in these. */
export function fit(canvas) {
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  const width = canvas.clientWidth;
  const height = canvas.clientHeight;
  if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
    canvas.width = Math.round(width * ratio);
    canvas.height = Math.round(height * ratio);
  }
  const context = canvas.getContext("2d");
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  context.clearRect(0, 0, width, height);
  return { context, width, height };
}

/** Call a function once before the next frame is shown, however often that is asked for. */
export function coalesced(draw) {
  let waits = false;
  return () => {
    if (waits) return;
    waits = true;
    requestAnimationFrame(() => {
      waits = false;
      draw();
    });
  };
}

export function number(value, digits = 1, unit = "") {
  return Number.isFinite(value) ? `${value.toFixed(digits)}${unit ? ` ${unit}` : ""}` : null;
}

/** Ask the server; what it refuses is thrown in its own words. */
export async function ask(path, body, method = body === undefined ? "GET" : "POST") {
  const options = { method, headers: {} };
  if (body !== undefined) {
    options.headers["Content-Type"] = "application/json";
    options.body = JSON.stringify(body);
  }
  let response;
  try {
    response = await fetch(path, options);
  } catch {
    throw new Error("the server does not answer");
  }
  const answer = await response.json().catch(() => ({}));
  if (response.status === 401) window.dispatchEvent(new Event("token-needed"));
  if (!response.ok) throw new Error(answer.error || `the server answered ${response.status}`);
  return answer;
}

const KIND_WORDS = {
  vanishing_point: "vanishing point",
  lowest_flow: "lowest flow",
  gap: "gap",
  single_plane: "single plane: a wall ahead",
  none: "no answer",
};

export const kindWords = (kind) => KIND_WORDS[kind] || kind;

export function answerWords(detection) {
  if (!detection) return "–";
  if (detection.kind === "none") return `no answer: ${(detection.reason || "").replaceAll("_", " ")}`;
  const away = Number.isFinite(detection.distance_m) ? `, ${detection.distance_m.toFixed(1)} m` : "";
  return `${kindWords(detection.kind)}${away}`;
}
