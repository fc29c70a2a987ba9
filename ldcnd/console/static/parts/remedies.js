/** Remedies as the daemon says them name commands of its interface; on a page they name buttons. */

const TERMS = [
  [/send power \{"on": true\}/g, "press Enable"],
  [/send home or set_position/g, "home the axis, or set its current position"],
  [/send reset/g, "press Reset"],
  [/send halt/g, "press Halt"],
  [/send set_gains|send at least kp and el/g, "write gains, at least kp and el"],
  [/send trace_abort/g, "press Abort on the trace page"],
  [/send clear_counter/g, "clear the counter"],
  [/send restart_eeprom_count/g, "press Count anew on the parameters page"],
  [/or acquire it with force/g, "or take it from there by the tick"],
  [/acquire (a new one|one first|it again|that axis, too)/g, "press Take control"],
];

/** Return a remedy in the words of the pages. */
export function inPageTerms(remedy) {
  return TERMS.reduce((text, [term, words]) => text.replace(term, words), remedy);
}
