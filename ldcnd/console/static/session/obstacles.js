/** What is in the way of a command, as the daemon says; what is said here concerns this page, or a press without a use. */

import { inPageTerms, whereElse } from "../parts/remedies.js";
import { controls } from "./control.js";

/** What buttons send, where that is not what they are called. */
const VERBS = { enable: "power", disable: "power", parameters: "read_parameter", none: null };
/** Presses that the daemon would carry out, without a use. */
const USELESS = {
  enable: (axis) => axis.state?.enabled && "The axis is enabled already.",
  disable: (axis) => axis.state && !axis.state.enabled && "The axis is disabled already.",
  halt: (axis) => axis.state && !moves(axis) && axis.state.moving === "no" && "The axis is not moving.",
  reset: (axis) =>
    axis.state &&
    !axis.state.stop_latched &&
    axis.state.state !== "error_stop" &&
    !axis.faults.length &&
    "Nothing to reset: no stop is latched, no fault is active.",
};

function notControlled(axis) {
  const where = whereElse("acquire", axis.name);
  return axis.holder ? `Control is held by ${axis.holder}: take it first${where}.` : `Take control first${where}.`;
}

/** Which sequence has control of an axis of this page now, in words: what moves by hand is refused meanwhile. */
function lentTo(axis, verb) {
  const { run, runs } = axis.rig;
  if (!runs || !run.axes.includes(axis.name) || !axis.rig.mayMove(verb)) return null;
  return `The ${run.kind} ${run.name} moves it: stop that, or wait for its end.`;
}

/** Return the first obstacle in words, or null.

 * `joins` says that a move may wait for, or end, the one under way.
 */
export function obstacle(axis, act, joins = false) {
  if (act !== "halt" && axis.rig.worth) return "No data from this rig: the state of the axis is unknown.";
  const verb = VERBS[act] === undefined ? act : VERBS[act];
  // a trace moves nothing: who only looks may take one where the daemon asks for no lease
  const isControlled = act === "trace" || !axis.rig.commands.get(verb)?.needs_lease || controls(axis);
  const here = lentTo(axis, verb) || (!isControlled && notControlled(axis)) || useless(axis, act);
  if (here) return here;
  const causes = act === "disable" ? [] : (axis.samples.obstacles?.[verb] ?? []); // nothing refuses what takes energy out
  const cause = causes.find(({ passes }) => !(joins && passes));
  return cause ? inWords({ ...cause, axis: axis.name }) : null;
}

/** Why an act would change nothing on an axis as it is, or false; of one whose readings are old nobody knows. */
export function useless(axis, act) {
  return axis.condition.live && USELESS[act]?.(axis);
}

/** Whether an act would change nothing on an axis as it is. */
export function isUseless(axis, act) {
  return Boolean(useless(axis, act));
}

/** Whether an act only takes energy out, as the daemon says of its command. */
export function calms(axis, act) {
  return act === "disable" || axis.rig.commands.get(act)?.effect === "rest";
}

/** Return what forbids a page to run what begins with a command of an axis, in words, or null; without a verb, control.

 * `waits` says that it waits for something before: for the end of a motion, or what an interlock requires.
 */
export function hindrance(axis, verb, waits = false) {
  if (axis.rig.worth) return "No data from this rig: the state of the axis is unknown.";
  if (!controls(axis)) return notControlled(axis);
  const causes = axis.samples.obstacles?.[verb] ?? [];
  const cause = causes.find(({ code, passes }) => !waits || !(passes || code === "interlock_violated"));
  return cause ? inWords({ ...cause, axis: axis.name }) : null;
}

function inWords(cause) {
  return `${cause.text}${cause.remedy ? `: ${inPageTerms(cause)}` : ""}.`;
}

/** Whether a motion is under way. */
export function moves(axis) {
  return Boolean(axis.condition.moves);
}
