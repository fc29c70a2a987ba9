/** The speed override of a rig: a share of every velocity; anyone may lower it, raising it needs control. */

import { html, useState } from "../html.js";
import { Action } from "../parts/controls.js";
import { number } from "../parts/format.js";
import { ofRigHalt } from "../parts/stop_all.js";
import { setSpeedOverride } from "../session/control.js";

const FULL = 100;
const SHARES = [0, 10, 25, 50, 100];

/** Return the override of a rig in percent; undefined while it is not known. */
export function overrideOf(rig) {
  return [...rig.axes.values()].map((axis) => axis.state?.speed_override).find((each) => each !== undefined);
}

/** Tell whether a rig is known to move slower than commanded. */
export function slowed(rig) {
  return overrideOf(rig) < FULL;
}

export function SpeedOverride({ rig }) {
  const shown = overrideOf(rig);
  const [kept, setKept] = useState([]); // what the last answer said: commands that go on at the speed of their beginning
  if (shown === undefined) return null;
  const keep = (reply) => setKept(reply.unchanged.map((name) => [name, rig.axes.get(name)?.state?.command?.command_id]));
  const going = kept.filter(([name, id]) => id && rig.axes.get(name)?.state?.command?.command_id === id);
  return html`<div class="speed" role="group" aria-label=${`Speed override of ${rig.name}`}>
    <span role="status">Speed <b>${number(shown, 0)} %</b></span>
    ${SHARES.map((share) => {
      const { onDone, onRefused } = ofRigHalt(rig, `Speed ${share} %`);
      return html`<${Action} key=${share} calms=${share === 0} act=${() => setSpeedOverride(rig, share)}
        onDone=${(reply) => { keep(reply); onDone(reply); }} onRefused=${share === 0 ? onRefused : null}>${`${share} %`}<//>`;
    })}
    ${going.length > 0 && html`<small role="status">${going.map(([name]) => name).join(", ")}: goes on at the speed with which it began</small>`}
  </div>`;
}
