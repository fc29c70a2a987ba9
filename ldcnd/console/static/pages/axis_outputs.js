/** Outputs: the pins of the limit switches, which can be driven instead of read. */

import { html, useState } from "../html.js";
import { Action, Choice, Panel } from "../parts/controls.js";
import { command } from "../session/control.js";
import { obstacle } from "../session/obstacles.js";

const MODES = [
  ["", "leave it"],
  ["input", "input"],
  ["high", "output, high"],
  ["low", "output, low"],
];

export function OutputsPanel({ axis }) {
  const [pins, setPins] = useState({});
  const pin = (name) => ({ value: pins[name], onChange: (value) => setPins({ ...pins, [name]: value || null }) });
  const chosen = Object.values(pins).some(Boolean);
  return html`<${Panel} title="Outputs" note="The pin of a limit switch can be an output. An axis that stops at its switches refuses.">
    <div class="fields">
      <${Choice} label="Limit 1 (reverse)" options=${MODES} ...${pin("limit1")} />
      <${Choice} label="Limit 2 (forward)" options=${MODES} ...${pin("limit2")} />
    </div>
    <p class="row"><${Action} kind="main" act=${() => command(axis, "set_outputs", pins)} onDone=${() => setPins({})}
      obstacle=${obstacle(axis, "set_outputs") ?? (chosen ? null : "Choose what a pin is to be.")}>Set outputs<//></p>
  <//>`;
}
