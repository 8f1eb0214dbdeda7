// Small plots over time, and the strip of states.

import { colour, fit, make, setText } from "./dom.js";

export const SPAN_S = 300;

const PLOTS = [
  { title: "Rates", unit: "/s", digits: 1, lines: [["frames_hz", "frames"], ["reports_hz", "answers"], ["setpoints_hz", "setpoints"]] },
  { title: "Ages", unit: "ms", digits: 0, lines: [["answer_age_ms", "answer"], ["pose_age_ms", "pose"]] },
  { title: "Time for an answer", unit: "ms", digits: 0, lines: [["detector_ms", "detector"]] },
  { title: "Confidence", unit: "", digits: 2, most: 1, lines: [["confidence", "confidence"]] },
];

export class Plots {
  constructor(box) {
    this.plots = PLOTS.map((plot) => {
      const canvas = make("canvas", { class: "plot", role: "img", "aria-label": plot.title });
      const values = plot.lines.map(([, name], at) => make("span", { class: `value line-${at}` }, make("span", { class: "swatch" }), make("span", {}, name), make("b", {}, "–")));
      box.append(make("figure", { class: "plot-box" }, make("figcaption", {}, make("span", { class: "plot-title" }, plot.title), ...values), canvas));
      return { ...plot, canvas, values };
    });
  }

  draw(series, now) {
    for (const plot of this.plots) this.drawOne(plot, series, now);
  }

  drawOne(plot, series, now) {
    const { context, width, height } = fit(plot.canvas);
    const shown = series.filter((point) => point.t >= now - SPAN_S);
    const all = shown.flatMap((point) => plot.lines.map(([name]) => point[name])).filter(Number.isFinite);
    const most = plot.most || nice(all.length ? Math.max(...all) : 1);
    const left = 34;
    const x = (time) => left + ((time - now + SPAN_S) / SPAN_S) * (width - left - 4);
    const y = (value) => height - 14 - (Math.min(value, most) / most) * (height - 20);
    context.font = "11px system-ui, sans-serif";
    context.fillStyle = colour("--muted");
    context.strokeStyle = colour("--grid");
    context.lineWidth = 1;
    context.textAlign = "right";
    context.textBaseline = "middle";
    for (const share of [0, 0.5, 1]) {
      const at = Math.round(y(most * share)) + 0.5;
      context.beginPath();
      context.moveTo(left, at);
      context.lineTo(width - 4, at);
      context.stroke();
      context.fillText(tick(most * share), left - 5, at);
    }
    context.textBaseline = "alphabetic";
    context.textAlign = "center";
    for (const back of [240, 180, 120, 60]) context.fillText(`−${back / 60} min`, x(now - back), height - 2);
    plot.lines.forEach(([name], at) => {
      context.strokeStyle = colour(`--line-${at}`);
      context.lineWidth = 1.8;
      context.beginPath();
      let before = null;
      for (const point of shown) {
        const value = point[name];
        if (!Number.isFinite(value)) {
          before = null;
          continue;
        }
        if (before !== null && point.t - before < 3) context.lineTo(x(point.t), y(value));
        else context.moveTo(x(point.t), y(value));
        before = point.t;
      }
      context.stroke();
      const newest = shown.length ? shown[shown.length - 1][name] : null;
      setText(plot.values[at].lastChild, Number.isFinite(newest) ? `${newest.toFixed(plot.digits)}${plot.unit ? ` ${plot.unit}` : ""}` : "–");
    });
    plot.canvas.setAttribute("aria-label", `${plot.title}: ${plot.values.map((value) => value.textContent).join(", ")}`);
  }
}

function nice(value) {
  const power = 10 ** Math.floor(Math.log10(Math.max(value, 1e-3)));
  return [1, 2, 5, 10].map((one) => one * power).find((one) => one >= value * 1.05) || 10 * power;
}

const tick = (value) => (value >= 10000 ? `${Math.round(value / 1000)}k` : value >= 10 || value === 0 ? String(Math.round(value)) : String(Number(value.toFixed(2))));

export const stateColour = (state) => colour(`--state-${(state || "none").toLowerCase()}`) || colour("--muted");

/** A strip of the states of the last minutes. states: changes, oldest first, with t and state. */
export function drawHistory(canvas, states, now) {
  const { context, width, height } = fit(canvas);
  context.fillStyle = colour("--well");
  context.fillRect(0, 0, width, height);
  states.forEach((change, at) => {
    const until = at + 1 < states.length ? states[at + 1].t : now;
    if (until < now - SPAN_S) return;
    const left = ((Math.max(change.t, now - SPAN_S) - now + SPAN_S) / SPAN_S) * width;
    const right = ((until - now + SPAN_S) / SPAN_S) * width;
    context.fillStyle = stateColour(change.state);
    context.fillRect(left, 0, Math.max(1, right - left), height);
  });
}
