/** A remedy names commands; on a page they are buttons. */

const PRESSED = {
  power: "press Enable",
  home: "home the axis",
  set_position: "set its current position",
  move_relative: "move it by a distance",
  jog: "hold a button of Jog",
  set_speed_override: "set the speed override of the rig",
  reset: "press Reset",
  halt: "press Halt",
  set_gains: "write gains, at least kp and el",
  set_outputs: "make the pin an input again, under Outputs",
  trace_abort: "press Abort on the trace page",
  clear_counter: "clear the counter",
  restart_eeprom_count: "press Count anew on the parameters page",
  list_parameters: "look at the list of parameters",
  acquire: "press Take control",
  events: "look at the events",
};

/** Return a remedy in the words of the pages; `told` is an error reply or a cause. */
export function inPageTerms({ remedy, steps = [] }) {
  return steps.reduce((text, { verb, said, arguments: given }) => {
    const words = verb === "acquire" && given?.force ? "take it from there by the tick" : (PRESSED[verb] ?? said);
    return text.replace(said, words);
  }, remedy);
}
