// The camera's picture with what the detector saw on it, layer by layer. Used for the live picture and for recordings.

export const LAYERS = [
  { id: "direction", name: "Direction", detail: false, on: true },
  { id: "planner", name: "Planner", detail: false, on: true, live: true },
  { id: "map", name: "Void map", detail: true, on: true },
  { id: "samples", name: "Ranges", detail: true, on: false, method: "parallax" },
  { id: "focus", name: "Focus of expansion", detail: true, on: false },
  { id: "features", name: "Features", detail: true, on: false, method: "paper" },
  { id: "dropped", name: "Flow dropped", detail: true, on: false, method: "paper" },
  { id: "flow", name: "Flow kept", detail: true, on: true, method: "paper" },
  { id: "clusters", name: "Clusters", detail: true, on: true, method: "paper" },
  { id: "lmcc", name: "LMCC", detail: true, on: true, method: "paper" },
  { id: "lines", name: "Lines", detail: true, on: true, method: "paper" },
  { id: "candidates", name: "Vanishing points", detail: true, on: true, method: "paper" },
];

const BLACK = "rgba(0,0,0,.75)";

/** Near is red, far is blue: the colour of a distance in m. */
export function rangeColour(distance, alpha = 1) {
  const stops = [[0.4, 235, 64, 52], [1.2, 247, 140, 50], [2.2, 250, 210, 70], [4, 60, 200, 150], [8, 66, 150, 250]];
  let at = 0;
  while (at < stops.length - 2 && distance > stops[at + 1][0]) at += 1;
  const [from, to] = [stops[at], stops[at + 1]];
  const share = Math.max(0, Math.min(1, (distance - from[0]) / (to[0] - from[0])));
  const [red, green, blue] = [1, 2, 3].map((i) => Math.round(from[i] + share * (to[i] - from[i])));
  return `rgba(${red},${green},${blue},${alpha})`;
}

/** Short flow is dark blue, long is yellow. */
function flowColour(share) {
  const stops = [[52, 76, 190], [140, 70, 190], [225, 90, 110], [250, 170, 60], [252, 240, 110]];
  const place = Math.max(0, Math.min(0.999, share)) * (stops.length - 1);
  const at = Math.floor(place);
  const mix = place - at;
  return `rgb(${[0, 1, 2].map((i) => Math.round(stops[at][i] + mix * (stops[at + 1][i] - stops[at][i]))).join(",")})`;
}

/**
 * Draw a scene.
 * size: [width, height] of the frame in px, which all points are in. layers: a set of ids.
 */
export function drawScene(canvas, { bitmap, size, detection, details, planner, layers }) {
  const [frameWidth, frameHeight] = size;
  const ratio = Math.min(window.devicePixelRatio || 1, 2);
  const width = Math.round(Math.max(canvas.clientWidth, 160) * ratio);
  const height = Math.round((width * frameHeight) / frameWidth);
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
    canvas.style.aspectRatio = `${frameWidth} / ${frameHeight}`;
  }
  const context = canvas.getContext("2d");
  context.setTransform(1, 0, 0, 1, 0, 0);
  context.globalAlpha = 1;
  if (bitmap) context.drawImage(bitmap, 0, 0, width, height);
  else context.clearRect(0, 0, width, height);
  const scale = width / frameWidth;
  context.setTransform(scale, 0, 0, scale, 0, 0);
  const pen = { context, unit: (ratio * 1.0) / scale, frameWidth, frameHeight };
  if (details) drawDetails(pen, details, layers);
  if (!details && layers.has("map") && detection) drawMap(pen, [...(detection.bearings || []), ...(detection.remembered || [])]);
  if (planner && layers.has("planner")) drawPlanner(pen, planner);
  if (detection && layers.has("direction")) drawDirection(pen, detection);
}

function drawDetails(pen, details, layers) {
  if (layers.has("map") && details.map) drawMap(pen, details.map);
  if (layers.has("samples") && details.samples) drawSamples(pen, details.samples, details.informative);
  if (layers.has("features") && details.features) drawFeatures(pen, details.features);
  if (details.flow) drawFlow(pen, details.flow, details.flow_filter || [], layers);
  if (layers.has("lines") && details.lines) drawLines(pen, details.lines);
  if (layers.has("clusters") && details.centres) drawClusters(pen, details.centres);
  if (layers.has("lmcc") && details.lmcc_px) disc(pen, ...details.lmcc_px, 7, "#ffe14d", 2);
  if (layers.has("candidates") && details.candidates) drawCandidates(pen, details.candidates);
  if (layers.has("focus") && details.focus_px) drawFocus(pen, details.focus_px);
}

/** Free distance by direction as a sketch of walls: near ones are tall and red. Rows: azimuth, distance, spread, x, y. */
function drawMap({ context, unit, frameWidth, frameHeight }, rows) {
  const seen = rows.filter((row) => row.length >= 5 && row[1] >= 0).sort((a, b) => a[3] - b[3]);
  if (!seen.length) return;
  const reach = 0.45 * frameWidth;
  seen.forEach(([, distance, , x, y], at) => {
    const left = at > 0 && x - seen[at - 1][3] < 0.12 * frameWidth ? (x + seen[at - 1][3]) / 2 : x - 0.012 * frameWidth;
    const right = at + 1 < seen.length && seen[at + 1][3] - x < 0.12 * frameWidth ? (x + seen[at + 1][3]) / 2 : x + 0.012 * frameWidth;
    const half = Math.min(0.42 * frameHeight, reach * 0.45 / Math.max(distance, 0.3));
    context.fillStyle = rangeColour(distance, 0.26);
    context.fillRect(left, y - half, right - left, 2 * half);
    context.fillStyle = rangeColour(distance, 0.95);
    context.fillRect(left, y - half - 1.2 * unit, right - left, 2.4 * unit);
    context.fillRect(left, y + half - 1.2 * unit, right - left, 2.4 * unit);
  });
}

function drawSamples({ context, unit }, samples, informative) {
  samples.forEach(([x, y, inverse], at) => {
    const tells = !informative || informative[at];
    context.fillStyle = tells ? rangeColour(inverse > 0.05 ? 1 / inverse : 20, 0.95) : "rgba(200,205,210,.35)";
    const side = (tells ? 3 : 2) * unit;
    context.fillRect(x - side / 2, y - side / 2, side, side);
  });
}

function drawFeatures({ context, unit }, features) {
  context.strokeStyle = "rgba(120,225,255,.85)";
  context.lineWidth = unit;
  context.beginPath();
  for (const [x, y] of features) {
    context.moveTo(x + 2.5 * unit, y);
    context.arc(x, y, 2.5 * unit, 0, 7);
  }
  context.stroke();
}

function drawFlow({ context, unit }, flow, filter, layers) {
  const kept = flow.filter((_, at) => (filter[at] ?? 2) === 2);
  const lengths = kept.map(([x0, y0, x1, y1]) => Math.hypot(x1 - x0, y1 - y0)).sort((a, b) => a - b);
  const longest = lengths.length ? lengths[Math.floor(0.95 * (lengths.length - 1))] || 1 : 1;
  context.lineWidth = 1.4 * unit;
  flow.forEach(([x0, y0, x1, y1], at) => {
    const passed = filter[at] ?? 2;
    if (!layers.has(passed === 2 ? "flow" : "dropped")) return;
    context.strokeStyle = passed === 2 ? flowColour(Math.hypot(x1 - x0, y1 - y0) / longest) : passed === 1 ? "rgba(255,90,90,.8)" : "rgba(190,195,200,.7)";
    context.beginPath();
    context.moveTo(x0, y0);
    context.lineTo(x1, y1);
    context.stroke();
    context.fillStyle = context.strokeStyle;
    context.fillRect(x1 - 1.3 * unit, y1 - 1.3 * unit, 2.6 * unit, 2.6 * unit);
  });
}

function drawLines({ context, unit }, lines) {
  context.strokeStyle = "#6cc7ff";
  context.lineWidth = 2 * unit;
  context.beginPath();
  for (const [x0, y0, x1, y1] of lines) {
    context.moveTo(x0, y0);
    context.lineTo(x1, y1);
  }
  context.stroke();
}

function drawClusters(pen, centres) {
  const sizes = centres.map((centre) => centre[2]);
  const [least, most] = [Math.min(...sizes), Math.max(...sizes)];
  for (const [x, y, size] of centres) disc(pen, x, y, 5, flowColour(most > least ? (size - least) / (most - least) : 0), 1.5);
}

function drawCandidates({ context, unit }, candidates) {
  for (const [x, y, role] of candidates) {
    const half = 8 * unit;
    for (const [width, stroke] of [[4, BLACK], [2, role === 2 ? "#ffffff" : role === 1 ? "#ff5a5a" : "#6b8cff"]]) {
      context.lineWidth = width * unit;
      context.strokeStyle = stroke;
      context.strokeRect(x - half, y - half, 2 * half, 2 * half);
      if (role === 1) {
        context.beginPath();
        context.moveTo(x - half, y - half);
        context.lineTo(x + half, y + half);
        context.stroke();
      }
    }
  }
}

function drawFocus({ context, unit }, [x, y]) {
  for (const [width, stroke] of [[4, BLACK], [2, "#ff9df5"]]) {
    context.lineWidth = width * unit;
    context.strokeStyle = stroke;
    context.beginPath();
    context.arc(x, y, 9 * unit, 0, 7);
    context.moveTo(x - 14 * unit, y);
    context.lineTo(x + 14 * unit, y);
    context.moveTo(x, y - 14 * unit);
    context.lineTo(x, y + 14 * unit);
    context.stroke();
  }
}

function drawPlanner({ context, unit, frameHeight }, [x]) {
  context.setLineDash([6 * unit, 5 * unit]);
  for (const [width, stroke] of [[4, BLACK], [2, "#ffb454"]]) {
    context.lineWidth = width * unit;
    context.strokeStyle = stroke;
    context.beginPath();
    context.moveTo(x, 0.12 * frameHeight);
    context.lineTo(x, 0.88 * frameHeight);
    context.stroke();
  }
  context.setLineDash([]);
  label({ context, unit }, "planned", x, 0.12 * frameHeight - 11 * unit, "#ffb454");
}

function drawDirection(pen, detection) {
  const { context, unit, frameWidth, frameHeight } = pen;
  if (detection.kind === "single_plane") {
    context.strokeStyle = "#ff8a3d";
    context.lineWidth = 8 * unit;
    context.strokeRect(4 * unit, 4 * unit, frameWidth - 8 * unit, frameHeight - 8 * unit);
    return;
  }
  const { x_px: x, y_px: y } = detection;
  if (!Number.isFinite(x)) return;
  const arm = 17 * unit;
  for (const [width, stroke] of [[6, BLACK], [2.6, "#ffffff"]]) {
    context.lineWidth = width * unit;
    context.strokeStyle = stroke;
    context.beginPath();
    context.moveTo(x - arm, y);
    context.lineTo(x + arm, y);
    context.moveTo(x, y - arm);
    context.lineTo(x, y + arm);
    context.stroke();
    context.beginPath();
    context.arc(x, y, 0.55 * arm, 0, 7);
    context.stroke();
  }
  if (Number.isFinite(detection.distance_m)) label(pen, `${detection.distance_m.toFixed(1)} m`, x, y + 30 * unit, "#ffffff");
}

function disc({ context, unit }, x, y, radius, fill, rim) {
  context.beginPath();
  context.arc(x, y, (radius + rim) * unit, 0, 7);
  context.fillStyle = BLACK;
  context.fill();
  context.beginPath();
  context.arc(x, y, radius * unit, 0, 7);
  context.fillStyle = fill;
  context.fill();
}

function label({ context, unit }, text, x, y, fill) {
  context.font = `600 ${13 * unit}px system-ui, sans-serif`;
  context.textAlign = "center";
  context.textBaseline = "middle";
  context.lineWidth = 3.5 * unit;
  context.strokeStyle = BLACK;
  context.strokeText(text, x, y);
  context.fillStyle = fill;
  context.fillText(text, x, y);
}

/** Make the switches of the layers; `changed` hears of the set that is on. Remembered under a name of the page's own. */
export function layerSwitches(box, { live, remember, changed }) {
  const stored = JSON.parse(localStorage.getItem(remember) || "{}");
  const shown = LAYERS.filter((layer) => live || !layer.live);
  const on = new Set(shown.filter((layer) => stored[layer.id] ?? layer.on).map((layer) => layer.id));
  const chips = new Map();
  for (const layer of shown) {
    const input = Object.assign(document.createElement("input"), { type: "checkbox", checked: on.has(layer.id), value: layer.id });
    const chip = document.createElement("label");
    chip.className = "chip";
    chip.append(input, document.createTextNode(layer.name));
    input.addEventListener("change", () => {
      if (input.checked) on.add(layer.id);
      else on.delete(layer.id);
      localStorage.setItem(remember, JSON.stringify(Object.fromEntries(shown.map((one) => [one.id, on.has(one.id)]))));
      changed(on);
    });
    chips.set(layer, chip);
    box.append(chip);
  }
  return {
    on,
    needsDetails: () => LAYERS.some((layer) => layer.detail && on.has(layer.id)),
    /** Show the switches of what these methods know. */
    forMethods(methods) {
      for (const [layer, chip] of chips) chip.hidden = Boolean(layer.method && methods.size && !methods.has(layer.method));
    },
  };
}
