// The socket to the live state: connects again by itself, keeps what is known, and tells what is new.

const RETRY_MS = [300, 700, 1500, 3000, 5000];
const KEPT = { log: 200, states: 300, series: 600, trail: 1500 };

export class Connection extends EventTarget {
  constructor() {
    super();
    this.latest = {};
    this.lists = { log: [], states: [], series: [], trail: [] };
    this.failures = 0;
    this.pictures = true;
    this.details = true;
    this.socket = null;
    this.clockOffset = null;
    document.addEventListener("visibilitychange", () => this.tellWants());
  }

  /** The service's monotonic time now, in s, as far as it is known. */
  now() {
    return this.clockOffset === null ? 0 : performance.now() / 1000 + this.clockOffset;
  }

  open() {
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(`${scheme}//${location.host}/api/live`);
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onopen = () => {
      this.failures = 0;
      this.tellWants();
      this.dispatchEvent(new CustomEvent("connection", { detail: { open: true } }));
    };
    socket.onmessage = (event) => {
      if (typeof event.data === "string") this.take(JSON.parse(event.data));
      else this.takePicture(event.data);
    };
    socket.onclose = (event) => {
      this.dispatchEvent(new CustomEvent("connection", { detail: { open: false, reason: event.reason } }));
      const delay = RETRY_MS[Math.min(this.failures, RETRY_MS.length - 1)];
      this.failures += 1;
      setTimeout(() => this.open(), delay);
    };
  }

  want(details) {
    if (this.details !== details) {
      this.details = details;
      this.tellWants();
    }
  }

  tellWants() {
    this.send({ type: "want", pictures: this.pictures && !document.hidden, details: this.details && !document.hidden });
  }

  send(message) {
    if (this.socket && this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
  }

  take(message) {
    if (message.type === "snapshot") {
      this.latest = {};
      for (const name of Object.keys(this.lists)) this.lists[name] = [];
    }
    Object.assign(this.latest, message.latest);
    for (const [name, entries] of Object.entries(message.appended || {})) {
      const list = this.lists[name];
      if (!list) continue;
      list.push(...entries);
      if (list.length > KEPT[name]) list.splice(0, list.length - KEPT[name]);
    }
    for (const name of ["pose", "status", "detection"]) {
      const time = message.latest[name] && message.latest[name].t;
      if (Number.isFinite(time)) this.hear(time);
    }
    this.dispatchEvent(new CustomEvent("state", { detail: message }));
  }

  /** What is newest was sent just now: the largest difference between its clock and ours is the nearest to the truth. */
  hear(time) {
    const offset = time - performance.now() / 1000;
    if (this.clockOffset === null || offset > this.clockOffset || this.clockOffset - offset > 5) this.clockOffset = offset;
  }

  async takePicture(data) {
    const length = new DataView(data).getUint32(0, true);
    const header = JSON.parse(new TextDecoder().decode(new Uint8Array(data, 4, length)));
    try {
      header.bitmap = await createImageBitmap(new Blob([new Uint8Array(data, 4 + length)], { type: "image/jpeg" }));
      this.hear(header.t);
      this.dispatchEvent(new CustomEvent("picture", { detail: header }));
    } finally {
      this.send({ type: "shown" });
    }
  }
}
