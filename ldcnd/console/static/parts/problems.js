/** Faults and warnings, faults first: the list that comes before everything else. */

import { number, words } from "./format.js";

const BUSY = 0.9;
/** As `ldcnd/model/trouble.py` has it, in whose words this speaks: a report sees a sample more or less at its edges. */
const ENOUGH = 0.9;
const EDGE_HZ = 1;
/** A few repeated exchanges a minute are a line's daily life; more deserve a look. */
const ERRORS_A_MINUTE = 5;
const COUNTERS = ["timeouts", "corrupt_replies", "rejected_packets"];

/** Return `{level, text, places: [{where, link, detail}]}` of everything that needs attention, "bad" before "warn".

 * What is said of several axes is said once. Values that change are details of a place, so that the list stands still.
 */
export function problems(rigs) {
  const found = new Map();
  for (const { level, text, where, link, detail } of [...rigs].flatMap((rig) => [...ofRig(rig)])) {
    const key = `${level} ${text}`;
    if (!found.has(key)) found.set(key, { level, text, places: [] });
    found.get(key).places.push({ where, link, detail });
  }
  return [...found.values()].sort((one, other) => (one.level === other.level ? 0 : one.level === "bad" ? -1 : 1));
}

function* ofRig(rig) {
  const link = "#/rig";
  if (rig.worth) {
    yield { level: "bad", where: rig.name, text: rig.worth.why, link };
    return; // nothing below it is known
  }
  if (rig.problem) yield { level: "bad", where: rig.name, text: rig.problem, link };
  if (rig.plan && !rig.plan.holds) {
    yield { level: "warn", where: rig.name, text: "A line is asked for more than it can carry.", link: "#/network" };
  }
  for (const bus of rig.buses.values()) yield* ofBus(rig, bus);
  // what has telemetry and no description is an I/O module, or an axis about to be described
  for (const axis of rig.axes.values()) if (axis.info) yield* ofAxis(rig, axis);
}

function* ofBus(rig, bus) {
  const at = { where: `${rig.name} · ${bus.name}`, link: "#/network" };
  if (bus.info && !bus.info.up) yield { ...at, level: "bad", text: `The line is not up: ${bus.info.problem}` };
  for (const remark of bus.info?.remarks ?? []) yield { ...at, level: "warn", text: remark };
  if (!bus.health) return;
  const errors = COUNTERS.reduce((sum, counter) => sum + bus.lately(counter), 0);
  if (errors > ERRORS_A_MINUTE) {
    yield { ...at, level: "warn", text: "Bad or missing replies within the last minute:", detail: errors };
  }
  if (bus.health.utilisation > BUSY) yield { ...at, level: "warn", text: "The line is full." };
}

function* ofAxis(rig, axis) {
  const at = { where: `${rig.name} · ${axis.name}`, link: `#/axis/${rig.name}/${axis.name}` };
  const { state, quality, health } = axis;
  const silent = state?.link === "down";
  if (state?.stop_pending) {
    yield { ...at, level: "bad", text: "A stop is NOT confirmed by the drive: use the machine's emergency stop." };
  }
  if (silent) yield { ...at, level: "bad", text: "The drive does not answer." };
  for (const fault of silent ? [] : axis.faults)
    yield { ...at, level: fault.stops ? "bad" : "warn", text: `${words(fault.code)}: ${fault.text}` };
  if (state?.state === "error_stop" && !axis.faults.length && state.link !== "down") {
    yield { ...at, level: "bad", text: `In error stop: ${state.last_error ?? "reset it to go on"}` };
  }
  if (state?.stop_latched && !state.stop_pending) yield { ...at, level: "warn", text: "A stop is latched: nothing moves before reset." };
  if (state?.link === "degraded") yield { ...at, level: "warn", text: "The drive missed its latest polls." };
  if (quality.level && state?.link !== "down")
    yield { ...at, level: quality.level, text: `Its values are ${quality.word}.` };
  for (const { figure, value, usual, unit, meaning, alarm } of axis.samples.shadow?.figures ?? []) {
    if (alarm) yield { ...at, level: "warn", text: `Motions take another ${figure} than usual: ${meaning}`, detail: `${number(value, 2)}, usual ${number(usual, 2)} ${unit}` };
  }
  const asked = health?.items.find(({ item }) => item === "position")?.asked_hz ?? health?.rate_wanted_hz;
  if (state?.link === "up" && health && health.rate_hz + EDGE_HZ < ENOUGH * asked) {
    yield { ...at, level: "warn", text: "Fewer samples a second than asked for:", detail: `${number(health.rate_hz, 0)} of ${number(asked, 0)}` };
  }
}
