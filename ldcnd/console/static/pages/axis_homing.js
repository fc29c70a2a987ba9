/** Homing with every condition; what is left empty comes from the axis's configuration. */

import { html, useId, useState } from "../html.js";
import { Action, Choice, Panel, Reason } from "../parts/controls.js";
import { NumberField, unread } from "../parts/number_field.js";
import { unitsOf } from "../parts/number_text.js";
import { HOME_METHODS, HOME_STOPS } from "../session/contract.js";
import { words } from "../parts/format.js";
import { command } from "../session/control.js";
import { obstacle } from "../session/obstacles.js";

const CONFIGURED = ["", "as configured"];
const STOPS = { smooth: "decelerate, hold", abrupt: "hold at once", off: "open the loop: it coasts" };

export function HomePanel({ axis }) {
  const [values, setValues] = useState({});
  const [name, setName] = useState(null);
  const [toHome, toSet] = [useId(), useId()];
  const set = (field) => (value) => setValues((last) => ({ ...last, [field]: value === "" ? null : value }));
  const empty = { hint: "empty: as configured" };
  const field = (label, of, key) =>
    html`<${NumberField} label=${label} ...${of === "s" ? { unit: of } : { units: unitsOf(axis.info, of) }} value=${values[key]} onChange=${set(key)} ...${empty} />`;
  const way = obstacle(axis, "home") ?? unread(values);
  const naming = obstacle(axis, "set_position") ?? unread({ Position: name }) ?? (name === null ? "A position is missing." : null);

  return html`<${Panel} title="Home">
    <div class="fields">
      <${Choice} label="Reference mark" value=${values.method} onChange=${set("method")}
        options=${[CONFIGURED, ...HOME_METHODS.map((each) => [each, words(each)])]} />
      <${Choice} label="At the mark" value=${values.stop} onChange=${set("stop")}
        options=${[CONFIGURED, ...HOME_STOPS.map((each) => [each, STOPS[each]])]} />
      ${field("Search velocity, signed", "velocity", "velocity")}
      ${field("Find a switch first at", "velocity", "find_velocity")}
      ${field("Acceleration", "acceleration", "acceleration")}
      ${field("Position at the mark", "position", "position")}
      ${field("Then move to", "position", "move_to")}
      ${field("Longest search", "s", "timeout_s")}
      ${field("Longest search", "position", "distance")}
    </div>
    <p class="row"><${Action} act=${() => command(axis, "home", values)} of=${[Object.entries(values), axis.state?.state].join()} obstacle=${way} reason=${toHome}
      kind="main">Home<//></p>
    ${way && html`<${Reason} id=${toHome} text=${way} />`}
    ${
      axis.can("set_position") &&
      html`<h3>Or set current position</h3>
      <div class="fields"><${NumberField} label="Current position is" units=${unitsOf(axis.info, "position")} value=${name} onChange=${setName}
        meaning=${(text) => `${axis.name} then stands at ${text}`} /></div>
      <p class="row"><${Action} act=${() => command(axis, "set_position", { position: name })} of=${[name, axis.state?.state].join()} obstacle=${naming}
        reason=${toSet} title="Nothing moves; afterwards the axis counts as homed">Set position<//></p>
      ${naming && html`<${Reason} id=${toSet} text=${naming} />`}`
    }
  <//>`;
}
