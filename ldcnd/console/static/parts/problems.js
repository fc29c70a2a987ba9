/** Faults and warnings, faults first: the list that comes before everything else. */

import { number } from "./format.js";

const BUSY = 0.9;
/** A few repeated exchanges a minute are a line's daily life; more deserve a look. */
const ERRORS_A_MINUTE = 5;
const COUNTERS = ["timeouts", "corrupt_replies", "rejected_packets"];

/** Return `{level, text, places: [{where, link, detail}]}` of everything that needs attention, "bad" before "warn".

 * What is wrong with axes has been decided by the console process, `ldcnd/contract/condition.py`. Each cause stands once, with
 * the names of all that it concerns. Values that change are details of a place, so that the list stands still.
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
  if (rig.attention) yield { level: "warn", where: rig.name, text: rig.attention, link };
  if (rig.plan && !rig.plan.holds) {
    yield { level: "warn", where: rig.name, text: "A line is asked for more than it can carry.", link: "#/network" };
  }
  for (const bus of rig.buses.values()) yield* ofBus(rig, bus);
  // what has telemetry and no description is an I/O module, or an axis about to be described
  for (const axis of rig.axes.values()) if (axis.info) yield* ofAxis(rig, axis);
}

function* ofBus(rig, bus) {
  const at = { where: `${rig.name} · ${bus.name}`, link: "#/network" };
  if (bus.up === false) yield { ...at, level: "bad", text: bus.problem };
  if (!bus.health) return;
  const errors = COUNTERS.reduce((sum, counter) => sum + bus.lately(counter), 0);
  if (errors > ERRORS_A_MINUTE) {
    yield { ...at, level: "warn", text: "Bad or missing replies within the last minute:", detail: errors };
  }
  for (const { module } of bus.health.modules ?? []) {
    yield* ofTroubles({ where: `${rig.name} · ${module}`, link: "#/network" }, rig.axis(module).condition, bus);
  }
  if (bus.up && bus.health.utilisation > BUSY) yield { ...at, level: "warn", text: "The line is full." };
}

function* ofTroubles(at, { troubles }, bus) {
  for (const { kind, level, text } of troubles) {
    if (!level) continue;
    const onLine = kind === "line_down" && bus; // one cause with the line's own
    yield { ...at, level, text: onLine ? bus.problem : text };
  }
}

function* ofAxis(rig, axis) {
  const at = { where: `${rig.name} · ${axis.name}`, link: `#/axis/${rig.name}/${axis.name}` };
  if (!axis.samples.condition) yield { ...at, level: "warn", text: "Nothing was received from it yet." };
  yield* ofTroubles(at, axis.condition, axis.bus);
  for (const { figure, value, usual, unit, meaning, alarm } of axis.samples.shadow?.figures ?? []) {
    if (alarm) yield { ...at, level: "warn", text: `Motions take another ${figure} than usual: ${meaning}`, detail: `${number(value, 2)}, usual ${number(usual, 2)} ${unit}` };
  }
}
