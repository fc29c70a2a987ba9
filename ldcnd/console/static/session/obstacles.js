/** What is in the way of a command as far as this page can see; the daemon has the last word. */

import { controls } from "./control.js";

const MOVING = new Set(["homing", "discrete_motion", "continuous_motion", "stopping"]);

const heard = (axis) => axis.rig.worth && "No data from this rig: the state of the axis is unknown.";
const reachable = (axis) => axis.state?.link === "down" && "The drive does not answer: check its power and the line.";
const unlatched = (axis) => axis.state?.stop_latched && "A stop is latched: reset first.";
const faultless = (axis) => axis.state?.state === "error_stop" && "The axis is in error stop: remove the cause, then reset.";
const enabled = (axis) => axis.state && !axis.state.enabled && "The axis is disabled: enable it first.";
const disabled = (axis) => axis.state?.enabled && "The axis is enabled already.";
const standing = (axis) => moves(axis) && "The axis moves: halt it and wait.";
const moving = (axis) => axis.state && !moves(axis) && axis.state.moving === "no" && "The axis is not moving.";
const referenced = (axis) =>
  axis.state && !axis.state.referenced && "The axis is not homed: home it, or set its current position.";
const resettable = (axis) =>
  axis.state &&
  !axis.state.stop_latched &&
  axis.state.state !== "error_stop" &&
  !axis.faults.length &&
  "Nothing to reset: no stop is latched, no fault is active.";

function controlled(axis) {
  if (controls(axis)) return false;
  return axis.holder ? `Control is held by ${axis.holder}: take it first.` : "Take control first.";
}

const toMove = [heard, controlled, reachable, unlatched, faultless, enabled, standing];
const toChange = [heard, controlled, reachable];
/** What other verbs need follows from their effect, which the daemon publishes. */
const CHECKS = {
  enable: [heard, controlled, reachable, unlatched, faultless, disabled],
  disable: [heard, controlled, reachable, enabled],
  reset: [heard, controlled, reachable, resettable],
  halt: [moving],
  move_absolute: [...toMove, referenced],
  track: [...toMove, referenced],
  set_position: [heard, controlled, reachable, standing],
  parameters: [heard, reachable],
  trace: [heard, reachable],
  none: [heard],
};

/** Return the first obstacle in words, or null.

 * `joins` says that a move may wait for, or end, the one under way.
 */
export function obstacle(axis, act, joins = false) {
  const { effects } = axis.rig;
  for (const check of CHECKS[act] ?? (effects[act] === "motion" ? toMove : toChange)) {
    if (joins && check === standing) continue;
    const text = check(axis);
    if (text) return text;
  }
  return null;
}

/** Whether a motion is under way. */
export function moves(axis) {
  return MOVING.has(axis.state?.state);
}
