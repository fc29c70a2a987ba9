/** What is in the way of a command, as the daemon says; what is said here concerns this page, or a press without a use. */

import { inPageTerms } from "../parts/remedies.js";
import { controls } from "./control.js";

const MOVING = new Set(["homing", "discrete_motion", "continuous_motion", "stopping"]);
/** What buttons are called that send a command in one of its forms. */
const VERBS = { enable: "power", disable: null, parameters: "read_parameter" };
const WITHOUT_CONTROL = new Set(["halt", "parameters", "trace", "none"]);
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
  if (controls(axis)) return null;
  return axis.holder ? `Control is held by ${axis.holder}: take it first.` : "Take control first.";
}

/** Return the first obstacle in words, or null.

 * `joins` says that a move may wait for, or end, the one under way.
 */
export function obstacle(axis, act, joins = false) {
  if (act !== "halt" && axis.rig.worth) return "No data from this rig: the state of the axis is unknown.";
  const here = (!WITHOUT_CONTROL.has(act) && notControlled(axis)) || USELESS[act]?.(axis);
  if (here) return here;
  const causes = axis.samples.obstacles?.[VERBS[act] === undefined ? act : VERBS[act]] ?? [];
  const cause = causes.find(({ passes }) => !(joins && passes));
  return cause ? inWords(cause) : null;
}

function inWords(cause) {
  return `${cause.text}${cause.remedy ? `: ${inPageTerms(cause)}` : ""}.`;
}

/** Whether a motion is under way. */
export function moves(axis) {
  return MOVING.has(axis.state?.state);
}
