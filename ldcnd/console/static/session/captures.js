/** Traces taken by this page: asked for, waited for, fetched and kept until the page goes. */

import { axisPath, read, Refusal } from "./api.js";
import { command } from "./control.js";
import { TRACE_UNDER_WAY } from "./contract.js";
import { feed } from "./feed.js";
import { changed } from "./rigs.js";

const MOST_KEPT = 12;
/** A drive's recorder is set up word by word. */
const ARMING_MS = 35_000;
/** Beyond its own time-out; while the daemon tells of progress, the time begins anew. */
const UPLOAD_S = 120;
/** Samples from before the trigger are gathered first. */
const ARMED_S = 30;
const MEASURED = new Set(["position", "velocity", "following_error", "adc"]);

/** A finished trace. */
export class Capture {
  constructor(axis, { header, offsets_ns: offsets, values }) {
    this.axis = axis;
    this.header = header;
    this.id = header.trace_id;
    this.seconds = Float64Array.from(offsets, (offset) => offset / 1e9);
    this.channels = header.channels.map((channel, column) => ({
      ...channel,
      signal: channel.unit === "",
      values: Float64Array.from(values[column], (value) => value ?? NaN),
    }));
  }

  /** The values of a channel, or null when it was not recorded. */
  channel(name) {
    return this.channels.find((each) => each.name === name) ?? null;
  }
}

const kept = [];

/** All captures, the newest first. */
export function captures() {
  return kept;
}

/** Forget a capture. */
export function discard(capture) {
  kept.splice(kept.indexOf(capture), 1);
  changed();
}

/** What a trace of this axis records besides measured values: 0 or 1. */
export function signalsOf(axis) {
  return axis.info.trace_channels.filter((name) => !MEASURED.has(name));
}

/** Arm a trace; returns once the daemon has granted it, with a promise of its capture. */
export async function arm(axis, request) {
  const { trace_id: id } = await command(axis, "trace", request, ARMING_MS);
  return { id, finished: finished(axis, id, (request.timeout_s ?? 30) + UPLOAD_S) };
}

/** Wait until a trace with a trigger counts triggers: what is to be recorded may begin. */
export async function watchful(axis, id) {
  const header = await reached(axis, id, (phase) => phase !== "filling", ARMED_S);
  if (header.phase !== "waiting")
    throw new Refusal({ message: `The trace is ${header.phase} before anything has happened.` }, 0);
}

/** Take a trace and keep it. */
export async function capture(axis, request) {
  const { finished: awaited } = await arm(axis, request);
  return keep(await awaited);
}

/** Keep a capture for overlays. */
export function keep(one) {
  kept.unshift(one);
  kept.length = Math.min(kept.length, MOST_KEPT);
  changed();
  return one;
}

/** Read the drive's signals once. */
export async function readSignals(axis) {
  const { finished: awaited } = await arm(axis, { channels: signalsOf(axis).slice(0, 8), samples: 2 });
  const one = await awaited;
  const values = Object.fromEntries(one.channels.map(({ name, values: column }) => [name, column.at(-1) === 1]));
  return { at: one.header.t, values };
}

/** Fetch the last complete trace of an axis, of any client. */
export async function fetchLast(axis) {
  return new Capture(axis, await read(`${axisPath(axis.rig.name, axis.name)}/trace`));
}

async function finished(axis, traceId, patienceS) {
  const header = await reached(axis, traceId, (phase) => !TRACE_UNDER_WAY.includes(phase), patienceS);
  if (header.phase !== "complete") {
    throw new Refusal(
      { message: `The trace is ${header.phase.replace("_", " ")}: ${header.problem ?? "no samples"}.` },
      0,
    );
  }
  const last = await fetchLast(axis);
  if (last.header.trace_id !== traceId) throw new Refusal({ message: "Another trace has taken the place of this one." }, 0);
  return last;
}

/** Wait until the header of a trace is in a phase that is wanted. */
function reached(axis, traceId, wanted, patienceS) {
  return new Promise((resolve, reject) => {
    let last = null;
    let timer = null;
    const look = () => {
      const header = axis.trace;
      if (header?.trace_id !== traceId || header === last) return;
      last = header;
      clearTimeout(timer);
      timer = setTimeout(() => end(reject, late), patienceS * 1e3);
      if (wanted(header.phase)) end(resolve, header);
    };
    const leave = feed.listen(() => look());
    const late = new Refusal(
      { message: "The trace did not get on in time.", remedy: "Abort it, and look at the line" },
      0,
    );
    timer = setTimeout(() => end(reject, late), patienceS * 1e3);
    function end(settle, outcome) {
      leave();
      clearTimeout(timer);
      settle(outcome);
    }
    look();
  });
}
