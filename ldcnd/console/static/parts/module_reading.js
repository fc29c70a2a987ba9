/** What the latest reading of a PIC-I/O module shows. */

/** A module is read at least twice a second. */
const OLD_S = 2;

export const levelsOf = (levels) => levels.map((level, index) => `${index + 1} ${level ? "high" : "low"}`).join(", ");

/** Return its named lines in their order, and all lines; unknown when it is old. */
export function readingOf(rig, module) {
  const seen = rig.axis(module);
  const { io } = seen.samples;
  const known = !rig.worth && seen.ageS("io") < OLD_S && io?.quality !== "bad";
  const named = Object.entries(io?.named ?? {}).map(([line, on]) => [line, known && on !== null ? (on ? "on" : "off") : "unknown"]);
  const lines = known ? levelsOf(io.levels) : "unknown";
  const outputs = known && io.outputs ? io.outputs.join(", ") || "none" : "unknown";
  return { named, known, all: [["lines", lines], ["outputs", outputs]] };
}
