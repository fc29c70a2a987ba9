/** Jog: run for as long as a button or an arrow key is held, or move by a step. */

import { html, useEffect, useId, useState } from "../html.js";
import { Action, Panel, Reason, RefusalText } from "../parts/controls.js";
import { NumberField, unread } from "../parts/number_field.js";
import { unitsOf } from "../parts/number_text.js";
import { number } from "../parts/format.js";
import { HoldButton } from "../parts/hold_button.js";
import { beginJog, command, endJog, forgetJogRefusal, jogRefusal } from "../session/control.js";
import { obstacle } from "../session/obstacles.js";

const STEPS = [-10, -1, -0.1, 0.1, 1, 10];
/** At first a jog has this share of the velocity limit: slow enough to let go in time. */
const FIRST_SHARE = 0.1;

export function JogPanel({ axis }) {
  const [speed, setSpeed] = useState(axis.info.limits.velocity * FIRST_SHARE);
  const reason = useId();
  useEffect(() => forgetJogRefusal, []);
  const { unit } = axis.info;
  const missing = unread({ Speed: speed }) ?? (speed > 0 ? null : "A speed above 0 is missing.");
  const way = obstacle(axis, "jog", true) ?? missing;
  const stepWay = obstacle(axis, "move_relative") ?? missing;

  return html`<${Panel} title="Jog" note="Runs while a button or, with it focused, an arrow key is held.">
    <div class="jog-line">
      <${NumberField} label="Speed" units=${unitsOf(axis.info, "velocity")} value=${speed} onChange=${setSpeed} min=${0} />
    <p class="row jog" role="group" aria-label=${`Jog ${axis.name}`}>
      <${HoldButton} begin=${() => beginJog(axis, -speed)} end=${endJog} keys=${["ArrowLeft"]} obstacle=${way}
        reason=${reason}>◀ Hold to run −<//>
      <${HoldButton} begin=${() => beginJog(axis, speed)} end=${endJog} keys=${["ArrowRight"]} obstacle=${way}
        reason=${reason}>Hold to run + ▶<//>
    </p></div>
    ${axis.can("move_relative") && html`<p class="row steps" role="group" aria-label=${`Steps of ${axis.name}`}>
      ${STEPS.map((step) => html`<${Action} key=${step} of=${[speed, axis.state?.state, unit].join()} obstacle=${stepWay} reason=${reason}
        act=${() => command(axis, "move_relative", { distance: step, velocity: speed })}
        >${step > 0 ? "+" : ""}${number(step, Math.abs(step) < 1 ? 1 : 0)} ${unit}<//>`)}
    </p>`}
    ${(way ?? stepWay) && html`<${Reason} id=${reason} text=${way ?? stepWay} />`}
    <${RefusalText} refusal=${jogRefusal} />
  <//>`;
}
