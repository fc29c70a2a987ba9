/** A remedy names commands; on a page they are buttons, of that page or of another one. */

const AXIS = ["axis"];
const PAGES_WITH_CONTROL = ["axis", "rig", "tuning", "parameters"]; // and with the power that goes with it
const RIG = ["rig"];
/** What is pressed for a command, which may depend on what it carries, and on which pages; the first is named on all
 * others. */
const PRESSED = {
  power: [({ on }) => (on === false ? "press Disable" : "press Enable"), PAGES_WITH_CONTROL],
  home: ["home the axis", ["axis", "rig"]],
  set_position: ["set its current position", AXIS],
  move_relative: ["move it by a distance", AXIS],
  jog: ["hold a button of Jog", AXIS],
  set_speed_override: ["set the speed override of the rig", RIG],
  reset: ["press Reset", PAGES_WITH_CONTROL],
  halt: ["press Halt", ["axis", "rig"]],
  set_gains: ["write gains, at least kp and el", ["axis", "tuning"]],
  set_io: null, // which output, and how, its own words say
  set_outputs: ["make the pin an input again, under Outputs", AXIS],
  trace_abort: ["press Abort", ["trace"]],
  clear_counter: ["clear the counter", ["parameters"]],
  restart_eeprom_count: ["press Count anew", ["parameters"]],
  list_parameters: ["look at the list of parameters", ["parameters"]],
  acquire: [
    ({ force }, where) => (force ? `take it from there${where ? "" : " by the tick"}` : "press Take control"),
    PAGES_WITH_CONTROL,
  ],
  list_lines: ["look at the line", ["network"]],
  events: ["look at the events", ["events"]],
};

/** The page that is open, as its address names it. */
const here = () => location.hash.slice(2).split("/")[0] || "rig";

/** Return where a command is pressed, as " on the page of x"; empty where that is the page that is open. */
export function whereElse(verb, axis) {
  const pages = PRESSED[verb]?.[1] ?? [here()];
  if (pages.includes(here())) return "";
  return ` on ${pages[0] === "axis" ? pageOf(axis) : `the ${pages[0]} page`}`;
}

/** Return how the page of an axis is called. */
export function pageOf(axis) {
  return axis ? `the page of ${axis}` : "the page of the axis";
}

/** Return what is pressed for a step of a remedy; what is a command line only is typed. */
function pressed({ verb, said, arguments: given }, where) {
  const words = PRESSED[verb]?.[0];
  if (words) return typeof words === "function" ? words(given ?? {}, where) : words;
  return said.startsWith("ldcnd ") ? `type ${said}` : said;
}

/** Return a remedy in the words of the pages; `told` is an error reply or a cause, with the name of its axis. */
export function inPageTerms({ remedy, steps = [], axis }) {
  return steps.reduce((text, step, at) => {
    const where = whereElse(step.verb, axis);
    const next = steps[at + 1];
    // of several commands on one other page, the last one names it
    const named = next && whereElse(next.verb, axis) === where ? "" : where;
    return text.replace(step.said, `${pressed(step, where)}${named}`);
  }, remedy);
}
