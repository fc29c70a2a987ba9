/** The speed override of a rig: a share of every velocity; anyone may lower it, raising it needs control. */

import { html, useState } from "../html.js";
import { Action, enterSends, Field, Panel } from "../parts/controls.js";
import { number } from "../parts/format.js";
import { setSpeedOverride } from "../session/control.js";

const SHARES = [0, 10, 25, 50, 100];

export function SpeedOverride({ rig }) {
  const [percent, setPercent] = useState(null);
  const shown = [...rig.axes.values()].map((axis) => axis.state?.speed_override).find((each) => each !== undefined);
  if (shown === undefined) return null;
  const missing = percent >= 0 && percent <= 100 && percent !== null ? null : "A percentage from 0 to 100 is missing.";
  return html`<${Panel} title="Speed override" note="Of every velocity. At 0 % what moves is halted and nothing begins.">
    <p role="status" data-level=${shown < 100 ? "warn" : null}>Now ${number(shown, 0)} %</p>
    <p class="row" role="group" aria-label="Speed override">
      ${SHARES.map((share) => html`<${Action} key=${share} act=${() => setSpeedOverride(rig, share)}>${share} %<//>`)}
    </p>
    <div class="fields" onKeyDown=${enterSends}>
      <${Field} label="Other" unit="%" value=${percent} onChange=${setPercent} min="0" />
      <${Action} kind="main" obstacle=${missing} act=${() => setSpeedOverride(rig, percent)}>Set<//>
    </div>
  <//>`;
}
