/** What is known of every rig: descriptions by GET, latest values by the feed, and how old they are. */

import { useLayoutEffect, useState } from "../html.js";
import { clock } from "../parts/format.js";
import { ask, notSent, read, rigPath } from "./api.js";
import { feed } from "./feed.js";

const DESCRIBED_EACH_MS = 5_000;
const DESCRIBED_ANEW_MS = 1_050;
const AGES_EACH_MS = 1_000;
const DRAWN_EACH_MS = 100;
const SILENT_AFTER_S = 3;
/** What is shown of an axis of which no condition came yet. */
const NOTHING_KNOWN = { known: false, live: false, mark: "no data", state: "unknown", alarm: "invalid", troubles: [] };
/** Of a daemon of which no sample has come yet. */
const CLOCK_UNKNOWN = { ns: NaN, atMs: 0 };
/** How far the daemon's clock may be ahead of `nsAt`, ns: longer than the quickest sample takes to this page. */
const CLOCK_AHEAD_NS = 250e6;
/** Long enough for a slow axis to count something, short enough to follow a change of velocity. */
const SLOPE_S = 0.3;
/** The drive's latest velocity may be older than its state. */
const AT_REST = new Set(["disabled", "standstill", "error_stop"]);
const REPORTS_KEPT = 61;
const EVENTS_KEPT = 1_000;
/** By then a stop that has come through is answered, or shown by the state. */
const STOP_SHOWN_MS = 1_000;
const LOOKED_EACH_MS = 20;
const EVENTS_ASKED = 200;
const ENDS_KEPT = 20;
/** Statuses with which a command is over. */
const FINAL = new Set(["done", "aborted", "refused", "failed", "unknown"]);
/** An observer speaks every ten seconds: an hour and a half. */
const SHADOWS_KEPT = 540;

/** One axis: its description and its latest samples. */
export class Axis {
  samples = {};
  monitors = {};
  trace = null;
  /** What a command for all axes was refused with here, in words; null when it was not. */
  refusal = null;
  shadows = [];
  /** The unit that it had before, since when it has another, and whether the operator has seen that; null while it had none. */
  unitChange = null;
  /** How often its units have changed: what was typed before means something else now. */
  unitChanges = 0;
  /** When it was last known not to answer, and when this page was pressed last to end motions, by this page's clock. */
  #outMs = -Infinity;
  #pressedMs = -Infinity;
  /** When the latch that stands was first told of, and the last reading, by the daemon's clock. */
  #latchedNs = 0;
  #readNs = 0;
  #info = null;
  #units = null;
  #told = {};
  #positions = [];
  #motion = { key: null, sinceNs: 0 };
  #ends = new Map();
  #arrived = new Map();
  /** The last stop of this page: since what count of which run, whether its answer is due, and what that has told. */
  #stop = { run: null, since: 0, due: false, told: 0, answeredMs: 0 };

  constructor(rig, name) {
    this.rig = rig;
    this.name = name;
  }

  /** Its description; null where the rig has none of it. */
  get info() {
    return this.#info;
  }

  set info(told) {
    const before = this.#units;
    this.#info = told;
    if (!told) return;
    this.#units = { unit: told.unit, all: JSON.stringify([told.unit, told.units, told.g_velocity]) };
    if (before && before.all !== this.#units.all) {
      this.unitChange = { from: before.unit, since: this.rig.daemon?.started ?? 0, seen: false };
      this.unitChanges += 1;
    }
    for (const [item, sample] of Object.entries(this.#told)) this.#judge(item, sample);
  }

  get bus() {
    return this.rig.buses.get(this.info?.bus) ?? null;
  }

  get state() {
    return this.samples.state ?? null;
  }

  get faults() {
    return this.samples.fault?.active ?? [];
  }

  /** Who controls it, as the console process has learned: null where no client does, empty where that is not known. */
  get holder() {
    return this.rig.worth || !this.samples.condition ? "" : this.samples.condition.holder;
  }

  /** The same in words. */
  get control() {
    return this.rig.worth ? "unknown" : this.condition.control || "unknown";
  }

  can(capability) {
    return this.info?.capabilities.includes(capability) ?? false;
  }

  /** Velocity in units a second: the slope of the latest positions of this motion, or of the standstill after it.

   * The drive's own, in whole counts a servo tick, is coarse: it counts until two positions are there. What was measured
   * before the motion has begun, or has ended, says nothing about it: null until something was measured since.
   */
  get velocity() {
    const { sinceNs } = this.#motion;
    const sample = this.samples.velocity;
    const told = sample && sample.t >= sinceNs && !AT_REST.has(this.state?.state) ? sample.value : null;
    const [first, last] = [this.#positions[0], this.#positions.at(-1)];
    if (!first || last.t === first.t) return told;
    return (this.#way(first, last) * 1e9) / (last.t - first.t);
  }

  /** The health report of its line says how often it is published, and how often that was wanted. */
  get health() {
    return this.bus?.health?.axes.find((each) => each.axis === this.name) ?? null;
  }

  /** Whether it stands under its latch, as its drive has shown since.
   *
   * The daemon latches at once and the drive confirms later, or never: what was read before says nothing about that.
   */
  get isStopped() {
    return Boolean(this.state?.stop_latched && !this.state.stop_pending && this.#readNs > this.#latchedNs && this.hasStoodSincePress);
  }

  /** Whether its drive has shown since the latest press that this page knows of that it stands. */
  get hasStoodSincePress() {
    const { state } = this;
    const answers = this.condition.live && state?.link === "up" && state.was_read !== false;
    return answers && state.moving === "no" && this.#readNs > this.rig.nsAt(this.#pressedMs) + CLOCK_AHEAD_NS;
  }

  /** Note a press that is to end its motion: nothing that was read before it shows that the axis stands. */
  notePress() {
    this.#pressedMs = performance.now();
    changed();
  }

  /** Note that this page stops it in one way or another: what is pressed from now on comes behind that.
   *
   * `answer` is the promise of how many stops the axis has counted with it.
   */
  noteStop(answer) {
    const stop = { run: this.now().run, since: this.state?.stops ?? 0, due: true, told: 0, answeredMs: 0 };
    this.#stop = stop;
    const told = (stops) => Object.assign(stop, { due: false, told: stops ?? 0, answeredMs: performance.now() });
    answer.then(told, () => told(0)); // what was not answered the state shows
  }

  /** How many of its stops this page knew of when this was asked, its own included; null where it shows none.
   *
   * A stop of this page is shown or answered within moments. Raises what refuses a press behind one that is not: sent, it
   * would overtake the stop; held back, it would come long after the hand.
   */
  async stopsNow() {
    const [shown, { run }, stop] = [this.state?.stops ?? null, this.now(), this.#stop];
    if (shown === null || stop.run !== run) return shown;
    if (!stop.due || shown > stop.since) {
      return performance.now() - stop.answeredMs < STOP_SHOWN_MS ? Math.max(shown, stop.told) : shown;
    }
    const latestMs = performance.now() + STOP_SHOWN_MS;
    while (stop.due && (this.state?.stops ?? 0) <= stop.since) {
      if (performance.now() > latestMs) {
        throw notSent("it is not known whether your stop has come through", "press again once it is shown", this);
      }
      await new Promise((next) => setTimeout(next, LOOKED_EACH_MS));
    }
    return stop.due ? stop.since + 1 : Math.max(shown, stop.told); // others that came meanwhile were not seen by the hand
  }

  take(item, sample) {
    const [kind, monitor] = item.split("/");
    if (item === "state" && sample?.stop_latched && !this.state?.stop_latched) this.#latchedNs = sample.t;
    if (item === "position" && sample && sample.quality !== "bad") this.#readNs = sample.t;
    if (item === "state" && sample?.state !== this.state?.state) this.refusal = null; // of a state that is over
    if (kind === "monitor") this.#keep(this.monitors, monitor, sample);
    else if (item === "trace") this.trace = sample;
    else if (kind !== "trace" && kind !== "event") {
      this.#keep(this.#told, item, sample?.unit ? sample : null); // what has a unit is judged anew by each description
      this.#judge(item, sample);
    }
    if ((item === "state" && sample?.link === "down") || (item === "condition" && sample?.live === false)) this.#outMs = performance.now();
    if (item === "position") this.#remember(sample);
    if (item === "state" && sample) this.#noteMotion(sample);
    if (item === "shadow" && sample) this.shadows = [...this.shadows, sample].slice(-SHADOWS_KEPT);
    if (sample?.t) this.#arrived.set(item, { atMs: performance.now(), ageS: Math.max(0, this.rig.nowNs() - sample.t) / 1e9 });
  }

  /** Age of a sample in seconds; null before the first. */
  ageS(item) {
    const arrived = this.#arrived.get(item);
    return arrived ? arrived.ageS + (performance.now() - arrived.atMs) / 1e3 : null;
  }

  /** When something is read of its drive, for `doubt`. */
  now() {
    return { atMs: performance.now(), run: this.rig.daemon?.instance };
  }

  /** Why what was read of its drive at `now()` may not hold any more; null while nothing tells so.
   *
   * `client` is the one whose own writes are known here.
   */
  doubt({ atMs, run }, client) {
    if (run !== this.rig.daemon?.instance) return "the daemon was started again since then.";
    if (!this.condition.live) return "the drive does not answer.";
    if (this.#outMs > atMs) return "the drive did not answer for a while since then, and may have lost its power.";
    const readNs = this.rig.nsAt(atMs);
    const since = this.rig.events.filter((event) => event.axis === this.name && event.t > readNs);
    if (since.some(({ verb }) => verb === "drive_changed")) return "the drive was reset or changed since then.";
    const other = since.findLast((event) => event.verb === "write_parameter" && event.client !== client && event.status !== "refused");
    return other ? `${other.client ?? "another client"} has written since then.` : null;
  }

  /** Whether its place is known and what is to be said of it, as the console process has decided; see `condition.py`. */
  get condition() {
    const told = this.samples.condition ?? NOTHING_KNOWN;
    const { worth } = this.rig; // that nothing comes from the console process only the page can know
    if (!worth || !told.live) return told;
    return { ...told, known: false, live: false, mark: worth.word, state: `unknown, was ${told.state}` };
  }

  /** How much the last values are worth now, in a word, and whether that needs attention. */
  get quality() {
    const { live, mark } = this.condition;
    if (!live) return { word: mark, level: "bad" };
    const sample = this.samples.position ?? this.samples.state;
    return { word: sample?.quality ?? mark, level: { good: "", uncertain: "warn" }[sample?.quality] ?? "bad" };
  }

  /** The way from one position to another: homing gives both another number, and the counts go on. */
  #way(first, last) {
    const { counts_per_unit: scale, direction } = this.info ?? {};
    return ((direction === "reverse" ? -1 : 1) * (last.counts - first.counts)) / (scale || 1);
  }

  #remember(sample) {
    const good = sample && sample.quality !== "bad";
    const before = this.#positions.filter(({ t, unit }) => unit === sample?.unit && t >= this.#motion.sinceNs && t < sample?.t);
    const recent = before.filter(({ t }) => sample.t - t <= SLOPE_S * 1e9);
    this.#positions = good ? [...(recent.length ? recent : before.slice(-1)), sample] : [];
  }

  /** The event with which a command ended; without an id that of the last motion. Null while none is known. */
  ended(commandId = null) {
    const mine = (event) =>
      event.axis === this.name && FINAL.has(event.status) &&
      (commandId ? event.command_id === commandId : this.rig.mayMove(event.verb) && event.status !== "refused");
    return this.rig.events.findLast(mine) ?? null;
  }

  /** Whether a motion began behind the last end that is known, and is not under way: how it ended nobody has seen. */
  endedUnseen() {
    const began = this.rig.events.findLast((event) => event.axis === this.name && this.rig.mayMove(event.verb) && event.status !== "refused");
    const open = began && !this.ended(began.command_id) && began.command_id !== this.state?.command?.command_id;
    return open && began.t < (this.rig.daemon?.started ?? 0) ? began : null;
  }

  /** Seconds from the end of a command's profile to its own end; null where the profile has none, or was not seen. */
  settlingS({ command_id: id, t }) {
    return this.#ends.has(id) ? Math.max(0, (t - this.#ends.get(id)) / 1e9) : null;
  }

  /** A motion begins or ends: only positions from then on belong to it. */
  #noteMotion({ t, state, moving, command }) {
    if (command?.expected_end) this.#ends = new Map([...this.#ends, [command.command_id, command.expected_end]].slice(-ENDS_KEPT));
    const key = `${state} ${moving} ${command?.command_id}`;
    if (key === this.#motion.key) return;
    this.#motion = { key, sinceNs: t };
    this.#positions = this.#positions.filter((each) => each.t >= t);
  }

  /** Keep a sample as far as it is in the units of the description: a restart of the daemon may bring others. */
  #judge(item, sample) {
    const unit = this.#info?.sample_units?.[item];
    const fits = !unit || !sample?.unit || sample.unit === unit;
    const fitting = fits ? sample : item === "state" ? { ...sample, command: sample.command && { ...sample.command, target: null } } : null;
    this.#keep(this.samples, item, fitting);
  }

  #keep(where, name, sample) {
    if (sample) where[name] = sample;
    else delete where[name];
  }
}

/** One line: its description, and its health reports of the last minute. */
export class Bus {
  info = null;
  reports = [];

  constructor(name) {
    this.name = name;
  }

  get health() {
    return this.reports.at(-1) ?? null;
  }

  report(sample) {
    if (!sample) this.reports = [];
    else this.reports = [...this.reports, sample].slice(-REPORTS_KEPT);
  }

  /** Whether its drives are polled; null while that is not known. */
  get up() {
    return this.health?.up ?? this.info?.up ?? null;
  }

  /** Why it is not up, in a sentence. */
  get problem() {
    return `The line is not up${this.info?.problem ? `: ${this.info.problem}` : "."}`;
  }

  /** By how much a counter has grown within the reports kept, a minute; a daemon begins again at 0. */
  lately(counter) {
    const counts = this.reports.map((report) => report[counter]);
    const grown = (count, before) => (count < before ? count : count - before);
    return counts.slice(1).reduce((sum, count, at) => sum + grown(count, counts[at]), 0);
  }
}

/** One rig and everything on it. */
export class Rig {
  connected = false;
  problem = null;
  /** What is to be seen to of its daemon, as the console process has decided. */
  attention = "";
  endpoint = "";
  daemon = null;
  plan = null;
  health = null;
  axes = new Map();
  buses = new Map();
  events = [];
  /** What the daemon says of each command, by its verb. */
  commands = new Map();
  /** Its sequences and named positions, as the console process has read them. */
  canRun = { runnables: [], problem: null };
  /** How far a sequence is, or the last one was; null before the first. */
  run = null;
  /** What was heard of it when its latest events were asked for; null before, and when they did not come. */
  caughtUp = null;
  heardAtMs = performance.now();
  #newest = CLOCK_UNKNOWN;

  constructor(name) {
    this.name = name;
  }

  /** What all its values are worth when nothing comes in; null while it does. */
  get worth() {
    if (!feed.live) return { word: "no data", level: "bad", why: "The console process sends nothing." };
    if (!this.connected) return { word: "no data", level: "bad", why: this.problem ?? "The daemon is not connected." };
    const silentS = (performance.now() - this.heardAtMs) / 1e3;
    if (silentS <= SILENT_AFTER_S) return null;
    // since when, not for how long: it stands in an alert, which is read aloud whenever it changes
    const heard = clock((performance.timeOrigin + this.heardAtMs) * 1e6).slice(0, -4);
    return { word: "old", level: "bad", why: `Nothing has been heard since ${heard}.` };
  }

  /** Forget what may have ended while this page heard nothing: what goes on comes with the first frame of a socket. */
  forgetPassing() {
    this.run = null;
    for (const axis of this.axes.values()) axis.trace = null;
  }

  /** Whether a sequence runs. */
  get runs() {
    return this.run !== null && !this.run.end;
  }

  /** Whether a command may make an axis move, as the daemon says. */
  mayMove(verb) {
    return this.commands.get(verb)?.effect === "motion";
  }

  axis(name) {
    if (!this.axes.has(name)) this.axes.set(name, new Axis(this, name));
    return this.axes.get(name);
  }

  bus(name) {
    if (!this.buses.has(name)) this.buses.set(name, new Bus(name));
    return this.buses.get(name);
  }

  describe(told) {
    this.endpoint = told.endpoint;
    this.connected = told.connected;
    this.problem = told.problem;
    this.attention = told.attention;
    if (told.daemon?.instance !== this.daemon?.instance) this.#newest = CLOCK_UNKNOWN; // its clock may be another
    this.daemon = told.daemon ?? this.daemon;
    this.plan = told.plan ?? this.plan;
    this.canRun = told.can_run;
    const described = Boolean(told.daemon);
    if (described) for (const axis of this.axes.values()) axis.info = null; // those that it has not any more keep none
    for (const bus of this.buses.keys()) if (described && !told.buses.some((each) => each.bus === bus)) this.buses.delete(bus);
    for (const info of told.buses) this.bus(info.bus).info = info;
    for (const info of told.axes) this.axis(info.axis).info = info;
    for (const info of told.commands?.commands ?? []) this.commands.set(info.verb, info);
    const place = ({ info }) => (info ? [info.bus, info.address] : ["", 0]);
    this.axes = new Map(
      [...this.axes].sort(([, one], [, other]) => {
        const [[bus, address], [otherBus, otherAddress]] = [place(one), place(other)];
        return bus.localeCompare(otherBus) || address - otherAddress;
      }),
    );
  }

  take(topic, sample) {
    this.heardAtMs = performance.now();
    if (sample?.t && !(sample.t <= this.nowNs())) this.#newest = { ns: sample.t, atMs: this.heardAtMs };
    const [root, name, ...rest] = topic.split("/");
    if (root === "tele") this.#telemetry(name, rest.join("/"), sample);
    else if (topic === "meta/health") this.health = sample;
    else if (root === "meta" && name === "health") this.bus(rest[0]).report(sample);
  }

  /** The time by the daemon's own clock, as late as its samples are here: that of another host may differ.
   *
   * NaN until the first sample has told it: what is compared with it is neither before nor after.
   */
  nowNs() {
    return this.nsAt(performance.now());
  }

  /** The same of an instant by this page's clock. */
  nsAt(atMs) {
    return this.#newest.ns + (atMs - this.#newest.atMs) * 1e6;
  }

  /** Add an event unless it is known. */
  happened(event) {
    if (this.events.some((each) => each.axis === event.axis && each.seq === event.seq && each.t === event.t)) return;
    this.events.push(event);
    this.events.sort((one, other) => one.t - other.t);
    if (this.events.length > EVENTS_KEPT) this.events.shift();
  }

  #telemetry(name, item, sample) {
    if (item === "event") {
      if (sample) this.happened(sample);
    } else {
      const axis = this.axis(name);
      const before = [axis.state?.link, axis.faults.length].join();
      axis.take(item, sample);
      if ((item === "state" || item === "fault") && before !== [axis.state?.link, axis.faults.length].join()) describeSoon(); // its registers
    }
  }
}

/** All rigs by name. */
export const rigs = new Map();

/** The axes of all rigs, those too that are not described. */
export function axesOf() {
  return [...rigs.values()].flatMap((rig) => [...rig.axes.values()]);
}

/** The name of an axis for a person, with that of its rig where there are several: rigs have axes of the same name. */
export function titleOf({ rig, name }) {
  return rigs.size > 1 ? `${rig.name} · ${name}` : name;
}

/** The names of axes for a person. */
export function namesOf(axes) {
  return axes.map(titleOf).join(", ");
}

/** The axis that an address names; null while, or because, there is none. */
export function axisNamed(at) {
  const axis = rigs.get(at.rig)?.axes.get(at.axis);
  return axis?.info ? axis : null;
}

/** Return in words that the axis of an address is not there. */
export function absence(at) {
  const rig = rigs.get(at.rig);
  if (!rig) return `Rig ${at.rig} is not known, or not known yet.`;
  if (!rig.daemon) return `Axis ${at.axis} of rig ${at.rig} is not known yet.`;
  return `Rig ${at.rig} has no axis ${at.axis}, or has it no more: choose another one.`;
}

/** Where rigs are looked for, and what is wrong there. */
export let endpoints = [];

/** Whether this console has a commissioning page. */
export let commissions = false;

/** Why the descriptions could not be read; null while they can. */
export let failure = null;

let described = false;

/** Whether this page knows all that there is to know: before that it has nothing to say of what moves or is wrong. */
export function isWhole() {
  return feed.live && described && [...rigs.values()].every((rig) => rig.worth || rig.daemon);
}

const watchers = new Set();
let drawnAtMs = 0;
let due = 0;

/** Redraw what shows rigs, at most ten times a second. */
export function changed() {
  if (due) return;
  const waitMs = Math.max(0, drawnAtMs + DRAWN_EACH_MS - performance.now());
  due = setTimeout(() => {
    due = 0;
    drawnAtMs = performance.now();
    for (const watcher of watchers) watcher();
  }, waitMs);
}

/** Redraw this component when something of any rig has changed. */
export function useRigs() {
  const [, redraw] = useState(0);
  useLayoutEffect(() => {
    const watcher = () => redraw((count) => count + 1);
    watchers.add(watcher);
    return () => watchers.delete(watcher);
  }, []);
  return rigs;
}

/** Return `act` such that it does nothing while it is still under way: questions must not pile up behind a slow answer. */
function unlessUnderWay(act) {
  let underWay = false;
  return async () => {
    if (underWay) return;
    underWay = true;
    try {
      await act();
    } finally {
      underWay = false;
    }
  };
}

/** Read all descriptions anew; values come by the feed. */
export const describe = unlessUnderWay(async () => {
  try {
    const { rigs: told, endpoints: looked, commissions: may } = await read("/api/rigs");
    endpoints = looked;
    for (const each of told) rigNamed(each.name).describe(each);
    commissions = may ?? false;
    failure = null;
    described = true;
  } catch (error) {
    failure = error;
  }
  catchUp();
  changed();
});

/** Read them again as soon as a change can be seen: the console process asks a daemon once a second at most. */
export function describeSoon() {
  describedSoon ||= setTimeout(() => {
    describedSoon = 0;
    describe();
  }, DESCRIBED_ANEW_MS);
}

let describedSoon = 0;

/** Begin to watch; once for a page. */
export function watch() {
  let spoken = 0;
  feed.listen((rig, topic, sample) => {
    if (feed.spoken > spoken) {
      for (const each of rigs.values()) each.forgetPassing();
      catchUp();
    }
    spoken = feed.spoken;
    if (rig !== null) {
      if (topic === "rig") joined(rigNamed(rig), sample);
      else if (topic === "run") rigNamed(rig).run = sample; // of the console process: no sign of life of the daemon
      else rigNamed(rig).take(topic, sample);
    }
    changed();
  });
  feed.open();
  describe();
  setInterval(describe, DESCRIBED_EACH_MS);
  setInterval(changed, AGES_EACH_MS); // ages grow by themselves
}

function rigNamed(name) {
  if (!rigs.has(name)) {
    const all = [...rigs.values(), new Rig(name)].sort((one, other) => one.name.localeCompare(other.name));
    rigs.clear();
    for (const rig of all) rigs.set(rig.name, rig);
  }
  return rigs.get(name);
}

function joined(rig, { connected, problem, attention }) {
  const came = connected && !rig.connected;
  Object.assign(rig, { connected, problem, attention });
  if (came) rig.caughtUp = null;
  if (came) describe(); // another run of the daemon may have other axes
}

/** Ask a rig for all events that it knows, page by page, and note from when on that is. */
export async function learnAllEvents(rig) {
  const page = (from_number) => ask(`${rigPath(rig.name)}/rig/events`, { from_number, count: EVENTS_KEPT });
  const first = await page(0);
  for (let { run, events, next_number: next, end_number: end } = first; run === first.run; ) {
    for (const event of events) rig.happened(event);
    if (next >= end) break;
    ({ run, events, next_number: next, end_number: end } = await page(next));
  }
  const discarded = first.events.length ? first.first_number : 0;
  rig.eventsBegin = { discarded, t: discarded ? first.events[0].t : rig.daemon?.started };
  changed();
}

/** Ask rigs for their latest events: of what happened before this page heard them, or while it did not. */
function catchUp() {
  for (const rig of rigs.values()) {
    const heard = `${feed.spoken} ${rig.daemon?.instance}`;
    if (!feed.live || !rig.connected || !rig.daemon || rig.caughtUp === heard) continue;
    rig.caughtUp = heard;
    learnEvents(rig, EVENTS_ASKED).catch((error) => {
      rig.caughtUp = null; // it is asked again: without them no end is known
      console.debug(error);
    });
  }
}

/** Ask a rig for its latest events. */
async function learnEvents(rig, count) {
  const { events } = await ask(`${rigPath(rig.name)}/rig/events`, { count });
  for (const event of events) rig.happened(event);
  changed();
}
