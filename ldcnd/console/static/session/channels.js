/** What a scope can show live: quantities of axes, and the curves that gather them. */

import { GrowingCurve } from "../parts/curve.js";
import { words } from "../parts/format.js";
import { feed } from "./feed.js";

const KEPT = 60_000;
const GAP_PERIODS = 5;
const SHORTEST_GAP_S = 0.5;
export const COLOURS = [1, 2, 3, 4, 5, 6, 7, 8].map((each) => `--curve-${each}`);
const DASHES = [[], [8, 4], [2, 3]];

/** One quantity of one axis. */
export class Channel {
  constructor(axis, item, field, title, unit, pane = unit) {
    Object.assign(this, { axis, item, field, title, unit, pane });
    this.key = `${axis.rig.name}/${axis.name}/${item}/${field}`;
    this.stream = `${axis.rig.name}/${axis.name}/${item}`;
    this.label = `${axis.rig.name} · ${axis.name} ${title}`;
  }

  /** How far apart samples may be before the line between them breaks. */
  get gapS() {
    return Math.max(SHORTEST_GAP_S, GAP_PERIODS / (this.axis.health?.rate_wanted_hz || 1));
  }
}

/** All channels of an axis. */
export function channelsOf(axis) {
  const { unit, items, monitors } = axis.info;
  const found = [new Channel(axis, "position", "value", "position", unit)];
  found.push(new Channel(axis, "velocity", "value", "velocity", `${unit}/s`));
  if (axis.info.capabilities.includes("power")) {
    found.push(new Channel(axis, "position", "following_error", "following error", unit, `${unit} error`));
  }
  if (items.includes("adc")) found.push(new Channel(axis, "adc", "volts", "A/D", "V"));
  for (const name of monitors) {
    found.push(new Channel(axis, `monitor/${name}`, "value", words(name), axis.monitors[name]?.unit || "raw"));
  }
  return found;
}

/** Return colour and dashes of the n-th curve: told apart without colour, too. */
export function look(index) {
  return { colour: COLOURS[index % COLOURS.length], dash: DASHES[Math.floor(index / 4) % DASHES.length] };
}

/** Gathers the samples of some channels for as long as it is not closed. */
export class Recording {
  #zeroMs = performance.now();
  /** Second 0 by the clock of each rig, ns since 1970. */
  #zeroNs = new Map();
  #byTopic = new Map();
  #leave;

  constructor(channels) {
    this.channels = channels;
    this.curves = channels.map((channel, index) => {
      const { label, unit, pane, gapS } = channel;
      const curve = new GrowingCurve({ label, unit, pane, gapS, ...look(index) }, KEPT);
      const topic = `${channel.axis.rig.name}/tele/${channel.axis.name}/${channel.item}`;
      const { axis } = channel;
      curve.mark = () => (axis.condition.live ? "" : axis.condition.mark); // beside a value that is not to be believed
      this.#byTopic.set(topic, [...(this.#byTopic.get(topic) ?? []), { curve, channel }]);
      return curve;
    });
    this.#leave = feed.listen((rig, topic, sample) => this.#take(`${rig}/${topic}`, sample));
    feed.stream([...new Set(channels.map((channel) => channel.stream))]);
  }

  /** Seconds since second 0. */
  now() {
    return (performance.now() - this.#zeroMs) / 1000;
  }

  close() {
    this.#leave();
    feed.stream([]);
  }

  #take(topic, sample) {
    for (const { curve, channel } of this.#byTopic.get(topic) ?? []) {
      if (!sample || (sample.unit && sample.unit !== channel.unit)) continue; // of a daemon that is not described yet
      const { field, axis: { rig } } = channel;
      const good = sample.quality !== "bad" && sample[field] !== null;
      if (!this.#zeroNs.has(rig)) this.#zeroNs.set(rig, rig.nsAt(this.#zeroMs));
      curve.push((sample.t - this.#zeroNs.get(rig)) / 1e9, good ? sample[field] : NaN);
    }
  }
}
