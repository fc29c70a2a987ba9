/** Who controls an axis, its power, and the four ways to end a motion. */

import { html, useId, useState } from "../html.js";
import { Action, Panel, Reason, Tick } from "../parts/controls.js";
import { stopAxis } from "../parts/stop_all.js";
import { command, controls, release, take } from "../session/control.js";
import { obstacle } from "../session/obstacles.js";
import { HolderWord } from "./rig.js";

export function AuthorityPanel({ axis }) {
  const mine = controls(axis);
  const [from, setFrom] = useState(null); // consent to take it from one client is none to take it from the next
  const others = !mine && axis.holder;
  const force = Boolean(others) && from === axis.holder;
  return html`<${Panel} title="Control">
    <p>${mine ? "Held by " : ""}<${HolderWord} axis=${axis} />${mine ? ". When this page closes, the console halts what it moved and ends control." : "."}</p>
    <p class="row">
      ${
        mine
          ? html`<${Action} key="release" act=${() => release([axis])} title="An axis that moves is halted first">Release control<//>`
          : html`<${Action} key="take" act=${() => take([axis], force)} kind="main"
            obstacle=${obstacle(axis, "none") ?? (others && !force ? `Control is held by ${axis.holder}: tick to take it from there.` : null)}>Take control<//>`
      }
      ${others && html`<${Tick} label=${`Take it from ${axis.holder}`} checked=${force}
        onChange=${(on) => setFrom(on ? axis.holder : null)} />`}
    </p>
    ${axis.can("power") && html`<${Power} axis=${axis} />`}
    ${axis.can("stop") && html`<${Endings} axis=${axis} />`}
  <//>`;
}

function Power({ axis }) {
  const on = axis.state?.enabled;
  const reasons = useId();
  const way = obstacle(axis, on ? "disable" : "enable");
  const toReset = obstacle(axis, "reset");
  return html`<h3>Power</h3>
    <p class="row">
      <${Action} key=${on} act=${() => command(axis, "power", { on: !on })} obstacle=${way} reason=${`${reasons}-power`}
        title=${on ? "Open the loop: the motor coasts, a hanging load falls" : "Close the loop at the present position; nothing moves"}
      >${on ? "Disable" : "Enable"}<//>
      <${Action} act=${() => command(axis, "reset")} obstacle=${toReset} reason=${`${reasons}-reset`}
        title="Clear the stop latch and the drive's faults; nothing moves">Reset<//>
    </p>
    ${way && html`<${Reason} id=${`${reasons}-power`} text=${`${on ? "Disable" : "Enable"}: ${way}`} />`}
    ${toReset && html`<${Reason} id=${`${reasons}-reset`} text=${`Reset: ${toReset}`} />`}`;
}

function Endings({ axis }) {
  const [told, setTold] = useState("");
  const reasons = useId();
  const toHalt = obstacle(axis, "halt");
  return html`<h3>End a motion</h3>
    <p class="row">
      <${Action} act=${() => command(axis, "halt")} obstacle=${toHalt} reason=${reasons}
        title="Decelerate and hold; no latch">Halt<//>
      <${Action} act=${() => stopAxis(axis)} kind="warn" onDone=${(reply) => setTold(confirmation(axis, reply))}
        title="Decelerate, hold, and latch until reset">Stop ${axis.name}<//>
      <${Action} act=${() => command(axis, "quick_stop")} kind="warn"
        title="Hold at once, without a ramp, and latch until reset">Quick stop<//>
    </p>
    ${toHalt && html`<${Reason} id=${reasons} text=${`Halt: ${toHalt}`} />`}
    <p role="status">${told}</p>
    <small>Anyone may end a motion, with or without control. Stop and quick stop latch until reset.</small>`;
}

function confirmation(axis, reply) {
  return reply.confirmed.includes(axis.name)
    ? "Stopped; the drive confirmed it."
    : "Stop sent; the drive has NOT confirmed it.";
}
