// The live samples: a WebSocket that reconnects automatically, and the last seconds of each axis in columns.

import { socket } from "./api.js";

export const KEPT_S = 20;
const RATE_HZ = 250; // few enough for a slow line, and close enough that no motor angle is passed over
const AGAIN_MS = [500, 1000, 2000, 5000];

/** The last KEPT_S of one axis, in arrays that are trimmed occasionally rather than at each sample. */
export class History {
  constructor() {
    this.columns = new Map();
    this.time = [];
  }

  push(time, columns) {
    // If the clock goes back, the loop was restarted: discard earlier samples.
    if (this.time.length && time.length && time[0] <= this.time.at(-1)) this.clear();
    this.time.push(...time);
    for (const [name, values] of Object.entries(columns)) {
      if (!this.columns.has(name)) this.columns.set(name, []);
      this.columns.get(name).push(...values);
    }
    const first = this.time.at(-1) - KEPT_S;
    if (this.time.length && this.time[0] < first - KEPT_S / 4) {
      const from = this.time.findIndex((each) => each >= first);
      this.time = this.time.slice(from);
      for (const [name, values] of this.columns) this.columns.set(name, values.slice(from));
    }
  }

  clear() {
    this.time = [];
    this.columns.clear();
  }

  column(name) {
    return this.columns.get(name) || [];
  }
}

export class Feed {
  /** onBatch(samples), onState("live" | "lost") */
  constructor(periodS, onBatch, onState) {
    this.every = Math.max(1, Math.round(1 / (RATE_HZ * periodS)));
    this.onBatch = onBatch;
    this.onState = onState;
    this.failures = 0;
    this.open();
  }

  open() {
    const line = socket("/live");
    line.onopen = () => line.send(JSON.stringify({ every: this.every }));
    line.onmessage = (message) => {
      const batch = JSON.parse(message.data);
      if (batch.type !== "samples") return;
      this.failures = 0;
      this.onState("live");
      this.onBatch(batch);
    };
    line.onclose = () => {
      this.onState("lost");
      const wait = AGAIN_MS[Math.min(this.failures, AGAIN_MS.length - 1)];
      this.failures += 1;
      setTimeout(() => this.open(), wait);
    };
  }
}
