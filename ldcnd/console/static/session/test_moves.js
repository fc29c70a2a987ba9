/** Test moves: a trace waits for the axis to move, the move is commanded once, and the samples are judged. */

import { Refusal } from "./api.js";
import { arm, watchful } from "./captures.js";
import { command, question } from "./control.js";
import { judge } from "./response.js";
import { changed } from "./rigs.js";

const MOST_RUNS = 8;
/** Settled is within so much of the distance, but no finer than some counts. */
const BAND = 0.02;
const BAND_COUNTS = 3;
const CHANNELS = ["position", "following_error", "velocity"];
/** Asked for; a slow line grants a longer one. */
const INTERVAL_S = 0.005;
const MOST_SAMPLES = 4_000;
const LEAD_S = 0.1;
/** The axis has begun to move when it has come so much of the way. */
const BEGUN = 0.05;

export const MOVES = {
  trapezoid: { title: "trapezoid", hint: "a relative move with the axis defaults" },
  steep: { title: "steepest trapezoid", hint: "a relative move at the velocity and acceleration limits" },
  step: { title: "step", hint: "one set-point without a profile; needs [bus.axis.tracking]" },
};

const all = new Map();
/** Which way the next test move of an axis goes, whatever became of the page and of the trace of the last one. */
const ways = new Map();
let counted = 0;

/** The runs of an axis, the newest first. */
export function runs(axis) {
  return all.get(axis) ?? [];
}

/** The sign of the next test move of an axis: against that of the last one. */
export function wayOf(axis) {
  return ways.get(axis) ?? 1;
}

/** Carry out one test move and judge it.
 *
 * It takes a while until the trace waits for it: nothing moves if by then the axis was stopped, or `isWanted` no more.
 * Raises what the daemon refuses it with; then nothing has moved.
 */
export async function runTest(axis, { kind, distance, settleS }, isWanted) {
  const after_stops = await axis.stopsNow();
  const start = axis.samples.position?.value;
  if (start === undefined) throw new Refusal({ message: "Where the axis is is not known." }, 0);
  const limits =
    kind === "steep" ? { velocity: axis.info.limits.velocity, acceleration: axis.info.limits.acceleration } : {};
  const profileS = kind === "step" ? 0 : await planned(axis, { distance, ...limits });
  const trigger = { channel: "position", kind: distance > 0 ? "rising" : "falling", level: start + BEGUN * distance };
  const { id, finished } = await armFor(axis, trigger, LEAD_S + profileS + settleS, INTERVAL_S);
  finished.catch(() => {}); // awaited below; a refused move leaves before that
  await watchful(axis, id);
  let reply;
  try {
    if (!isWanted()) throw new Refusal({ message: "Nothing has moved: this page was left meanwhile." }, 0);
    reply =
      kind === "step"
        ? await command(axis, "track", { position: start + distance, after_stops })
        : await command(axis, "move_relative", { distance, ...limits, after_stops });
  } catch (error) {
    command(axis, "trace_abort", { after_stops: null }).catch(() => {}); // it would wait for a motion that does not come
    throw error;
  }
  ways.set(axis, -Math.sign(distance)); // it goes, and whether a trace comes of it or not it will have gone
  changed();
  const capture = await finished;
  return keep(axis, run(axis, kind, distance, reply, capture));
}

async function planned(axis, body) {
  const { refusal, duration_s: duration } = await question(axis, "preview", body);
  if (refusal) throw new Refusal(refusal, 409);
  return duration;
}

/** Arm a trace of so many seconds, as dense as the line allows; tracing moves nothing, so it may be asked for twice. */
async function armFor(axis, trigger, seconds, intervalS) {
  const samples = Math.min(MOST_SAMPLES, Math.ceil(seconds / intervalS));
  const request = {
    channels: CHANNELS,
    samples,
    interval_s: intervalS,
    trigger,
    pre_trigger: Math.ceil(LEAD_S / intervalS),
  };
  try {
    return await arm(axis, request);
  } catch (error) {
    if (error.code === "value_out_of_range" && error.nearest > intervalS)
      return armFor(axis, trigger, seconds, error.nearest);
    throw error;
  }
}

function run(axis, kind, distance, reply, capture) {
  const counts = axis.info.counts_per_unit ?? 1;
  const band = Math.max(BAND * Math.abs(distance), BAND_COUNTS / counts);
  const position = capture.channel("position").values;
  // a reply counts within a turn, a trace through all of them
  const { modulo } = axis.info;
  const turns = modulo ? modulo * Math.round((position[0] - reply.position + distance) / modulo) : 0;
  const target = reply.position + turns;
  const start = target - distance;
  const error = capture.channel("following_error").values;
  const result = judge({
    seconds: capture.seconds,
    position,
    error,
    start,
    target,
    band,
    profileS: reply.duration_s ?? 0,
  });
  const gains = Object.fromEntries(axis.info.registers.map(({ name, value }) => [name, value]));
  return { number: ++counted, kind, distance, start, target, band, capture, result, gains };
}

function keep(axis, one) {
  all.set(axis, [one, ...runs(axis)].slice(0, MOST_RUNS));
  changed();
  return one;
}
