// The flight from above: north is up, the vehicle in the middle.

import { colour, fit } from "./dom.js";
import { rangeColour } from "./scene.js";

export class TopView {
  constructor(canvas) {
    this.canvas = canvas;
    this.radius = 4.5; // m from the middle to the nearest edge
  }

  zoom(factor) {
    this.radius = Math.max(1.5, Math.min(80, this.radius * factor));
  }

  draw({ pose, trail, setpoint, detection, details }) {
    const { context, width, height } = fit(this.canvas);
    const middle = pose ? pose.ned_m : trail.length ? trail[trail.length - 1] : [0, 0];
    const scale = Math.min(width, height) / 2 / this.radius;
    const place = ([north, east]) => [width / 2 + (east - middle[1]) * scale, height / 2 - (north - middle[0]) * scale];
    this.grid(context, width, height, scale, middle);
    const from = (detection && detection.position_m) || middle;
    const rows = details && details.map && details.map.length ? details.map : detection ? [...(detection.remembered || []), ...(detection.bearings || [])] : [];
    this.free(context, rows, from, place);
    if (trail.length > 1) {
      context.strokeStyle = colour("--trail");
      context.lineWidth = 2;
      context.beginPath();
      trail.forEach((point, at) => (at ? context.lineTo(...place(point)) : context.moveTo(...place(point))));
      context.stroke();
    }
    if (detection && detection.obstacles) {
      context.fillStyle = colour("--bad");
      for (const obstacle of detection.obstacles) {
        const [x, y] = place(obstacle);
        context.fillRect(x - 2.5, y - 2.5, 5, 5);
      }
    }
    if (setpoint) this.setpoints(context, setpoint, place, middle);
    if (pose) this.vehicle(context, width / 2, height / 2, (pose.heading_deg * Math.PI) / 180);
    else {
      context.fillStyle = colour("--muted");
      context.font = "14px system-ui, sans-serif";
      context.textAlign = "center";
      context.fillText("no pose", width / 2, height / 2);
    }
  }

  grid(context, width, height, scale, [north, east]) {
    const step = [0.5, 1, 2, 5, 10, 20].find((one) => one * scale >= 34) || 50;
    context.strokeStyle = colour("--grid");
    context.lineWidth = 1;
    context.beginPath();
    for (let at = Math.ceil((east - width / 2 / scale) / step) * step; at < east + width / 2 / scale; at += step) {
      const x = Math.round(width / 2 + (at - east) * scale) + 0.5;
      context.moveTo(x, 0);
      context.lineTo(x, height);
    }
    for (let at = Math.ceil((north - height / 2 / scale) / step) * step; at < north + height / 2 / scale; at += step) {
      const y = Math.round(height / 2 - (at - north) * scale) + 0.5;
      context.moveTo(0, y);
      context.lineTo(width, y);
    }
    context.stroke();
    context.fillStyle = colour("--muted");
    context.font = "12px system-ui, sans-serif";
    context.textAlign = "left";
    context.fillText(`${step} m`, 8, height - 8);
    context.textAlign = "center";
    context.fillText("N", width / 2, 14);
  }

  free(context, rows, from, place) {
    const half = (2 * Math.PI) / 180;
    for (const [azimuthDeg, distance] of rows) {
      const azimuth = (azimuthDeg * Math.PI) / 180;
      const corner = (angle) => place([from[0] + Math.cos(angle) * distance, from[1] + Math.sin(angle) * distance]);
      context.beginPath();
      context.moveTo(...place(from));
      context.lineTo(...corner(azimuth - half));
      context.lineTo(...corner(azimuth + half));
      context.closePath();
      context.fillStyle = rangeColour(distance, 0.2);
      context.fill();
      context.beginPath();
      context.moveTo(...corner(azimuth - half));
      context.lineTo(...corner(azimuth + half));
      context.strokeStyle = rangeColour(distance, 0.95);
      context.lineWidth = 2;
      context.stroke();
    }
  }

  setpoints(context, setpoint, place, middle) {
    const goal = setpoint.goal_ned && place(setpoint.goal_ned);
    const sent = setpoint.decided_ned && place(setpoint.decided_ned);
    context.lineWidth = 2;
    if (goal) {
      context.setLineDash([5, 4]);
      context.strokeStyle = colour("--planned");
      context.beginPath();
      context.moveTo(...place(middle));
      context.lineTo(...goal);
      context.stroke();
      context.setLineDash([]);
      context.beginPath();
      context.arc(...goal, 7, 0, 7);
      context.stroke();
    }
    if (sent) {
      context.strokeStyle = colour("--accent");
      context.fillStyle = colour("--accent");
      context.beginPath();
      context.moveTo(...place(middle));
      context.lineTo(...sent);
      context.stroke();
      context.beginPath();
      context.moveTo(sent[0], sent[1] - 7);
      context.lineTo(sent[0] + 7, sent[1]);
      context.lineTo(sent[0], sent[1] + 7);
      context.lineTo(sent[0] - 7, sent[1]);
      context.fill();
    }
  }

  vehicle(context, x, y, heading) {
    context.save();
    context.translate(x, y);
    context.rotate(heading);
    context.beginPath();
    context.moveTo(0, -12);
    context.lineTo(8, 9);
    context.lineTo(0, 5);
    context.lineTo(-8, 9);
    context.closePath();
    context.fillStyle = colour("--text");
    context.strokeStyle = colour("--card");
    context.lineWidth = 2;
    context.fill();
    context.stroke();
    context.restore();
  }
}
