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
  /** How many sockets have spoken: what happened between two of them came by none. */
  spoken = 0;
  #listeners = new Set();
  #streams = [];
  #socket = null;
  #coming = null;
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

  /** Connect; an older socket is heard until the new one speaks. */
  open() {
    const query = new URLSearchParams({ rate: RATE_HZ });
    if (this.#streams.length) query.set("stream", this.#streams.join());
    const socket = new WebSocket(`${location.origin.replace(/^http/, "ws")}/api/feed?${query}`);
    this.#coming?.close();
    this.#coming = socket;
    socket.binaryType = "arraybuffer";
    socket.onmessage = ({ data }) => {
      if (socket === this.#coming) {
        this.#socket?.close();
        [this.#socket, this.#coming] = [socket, null];
        this.spoken += 1;
      }
      if (socket === this.#socket) this.#take(decode(data));
    };
    socket.onclose = () => {
      if (socket === this.#coming) this.#coming = null;
      else if (socket === this.#socket) this.#socket = null;
      else return;
      if (!this.#socket) this.#lose();
      if (!this.#coming) this.#openLater();
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
    const silent = [this.#socket, this.#coming];
    this.#socket = this.#coming = null; // what they still say counts no more
    for (const socket of silent) socket?.close();
    this.#lose();
    this.#openLater();
  }

  #lose() {
    this.#heardAtMs = -Infinity;
    clearTimeout(this.#silence);
    for (const listener of this.#listeners) listener(null, "lost", null);
  }

  #openLater() {
    setTimeout(() => this.open(), this.#pauseMs);
    this.#pauseMs = Math.min(2 * this.#pauseMs, LONGEST_PAUSE_MS);
  }
}

export const feed = new Feed();
