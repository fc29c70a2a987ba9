/** Telemetry: one read-only WebSocket, opened again whenever it is lost or other streams are wanted. */

import { decode } from "../vendor/msgpack/decode.mjs";

const RATE_HZ = 10;
const FIRST_PAUSE_MS = 500;
const LONGEST_PAUSE_MS = 4_000;
/** Longest time without a frame for which values are shown as present, ms: a frame comes at least twice a second. */
const SILENCE_MS = 1_000;
/** So much means that the console process, or the way to it, is gone: another socket is tried. */
const GONE_MS = 3_000;

/** A feed hands entries on as they come; who listens decides what is kept. */
export class Feed {
  /** Samples that the console process had to drop for this page, because it was too slow. */
  dropped = 0;
  #listeners = new Set();
  #streams = [];
  #socket = null;
  #silence = 0;
  #heardAtMs = -Infinity;
  #pauseMs = FIRST_PAUSE_MS;

  /** Whether the latest frame is young enough: by the clock, so that a page that slept has no old values when it wakes. */
  get live() {
    return performance.now() - this.#heardAtMs < SILENCE_MS;
  }

  /** Call `listener(rig, topic, sample)` for every entry; returns what ends that. */
  listen(listener) {
    this.#listeners.add(listener);
    return () => this.#listeners.delete(listener);
  }

  /** Receive every sample of these keys, `<rig>/<axis>/<item>`, beside the latest value of everything. */
  stream(keys) {
    if (keys.join() === this.#streams.join()) return;
    this.#streams = keys;
    this.open();
  }

  /** Connect; an older socket is kept until the new one speaks. */
  open() {
    const query = new URLSearchParams({ rate: RATE_HZ });
    if (this.#streams.length) query.set("stream", this.#streams.join());
    const socket = new WebSocket(`${location.origin.replace(/^http/, "ws")}/api/feed?${query}`);
    const before = this.#socket;
    this.#socket = socket;
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => {
      if (socket !== this.#socket) return;
      before?.close();
      this.#take(decode(data));
    };
    socket.onclose = () => {
      if (socket !== this.#socket) return;
      before?.close();
      this.#lost();
    };
  }

  #take([_sentNs, dropped, entries]) {
    this.#heardAtMs = performance.now();
    clearTimeout(this.#silence);
    this.#silence = setTimeout(() => this.#fallSilent(), SILENCE_MS);
    this.#pauseMs = FIRST_PAUSE_MS;
    this.dropped = dropped;
    for (const [rig, topic, sample] of entries) {
      for (const listener of this.#listeners) listener(rig, topic, sample);
    }
  }

  #fallSilent() {
    this.#silence = setTimeout(() => this.#giveUp(), GONE_MS - SILENCE_MS);
    for (const listener of this.#listeners) listener(null, "silent", null);
  }

  #giveUp() {
    const silent = this.#socket;
    this.#socket = null; // what it still says counts no more
    silent.close();
    this.#lost();
  }

  #lost() {
    this.#heardAtMs = -Infinity;
    clearTimeout(this.#silence);
    for (const listener of this.#listeners) listener(null, "lost", null);
    setTimeout(() => this.open(), this.#pauseMs);
    this.#pauseMs = Math.min(2 * this.#pauseMs, LONGEST_PAUSE_MS);
  }
}

export const feed = new Feed();
