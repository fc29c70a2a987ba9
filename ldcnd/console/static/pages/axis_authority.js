/** Who controls an axis, and its power; what ends a motion is in the strip above. */

import { html, useId, useState } from "../html.js";
import { Action, Panel, Reason, Swap, Tick } from "../parts/controls.js";
import { ifUnheard } from "../parts/stop_all.js";
import { command, controls, release, take } from "../session/control.js";
import { obstacle } from "../session/obstacles.js";
import { HolderWord } from "./rig_axes.js";

export function AuthorityPanel({ axis }) {
  const mine = controls(axis);
  const [from, setFrom] = useState(null); // consent to take it from one client is none to take it from the next
  const others = !mine && axis.holder;
  const force = Boolean(others) && from === axis.holder;
  return html`<${Panel} title="Control">
    <p>${mine ? "Held by " : ""}<${HolderWord} axis=${axis} />${mine ? ". When this page closes, the console halts what it moved and ends control." : "."}</p>
    <div class="row">
      <${Swap}>${
        mine
          ? html`<${Action} key="release" act=${() => release([axis])} title="An axis that moves is halted first">Release control<//>`
          : html`<${Action} key="take" act=${() => take([axis], force)} onDone=${() => setFrom(null)} kind="main"
            obstacle=${obstacle(axis, "none") ?? (others && !force ? `Control is held by ${axis.holder}: tick to take it from there.` : null)}>Take control<//>`
      }<//>
      ${others && html`<${Tick} label=${`Take it from ${axis.holder}`} checked=${force}
        onChange=${(on) => setFrom(on ? axis.holder : null)} />`}
      ${axis.can("power") && html`<${Power} axis=${axis} />`}
    </div>
  <//>`;
}

function Power({ axis }) {
  const on = axis.state?.enabled;
  const reasons = useId();
  const way = obstacle(axis, on ? "disable" : "enable");
  const toReset = obstacle(axis, "reset");
  return html`<${Swap}><${Action} key=${on} calms=${on} act=${() => command(axis, "power", { on: !on })} obstacle=${way} reason=${`${reasons}-power`}
        onRefused=${on ? ifUnheard(axis, "disable", "Disable") : null}
        title=${on ? "Open the loop: the motor coasts, a hanging load falls" : "Close the loop at the present position; nothing moves"}
      >${on ? "Disable" : "Enable"}<//><//>
      <${Action} act=${() => command(axis, "reset")} obstacle=${toReset} reason=${`${reasons}-reset`}
        title="Clear the stop latch and the drive's faults; nothing moves">Reset<//>
    <div class="power-ways">${
      way === toReset
        ? html`<span id=${`${reasons}-power`}><${Reason} id=${`${reasons}-reset`} text=${way} /></span>`
        : html`${way && html`<${Reason} id=${`${reasons}-power`} text=${`${on ? "Disable" : "Enable"}: ${way}`} />`}
          ${toReset && html`<${Reason} id=${`${reasons}-reset`} text=${`Reset: ${toReset}`} />`}`
    }</div>`;
}
