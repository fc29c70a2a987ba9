/** What is wrong with an axis, what came first, what to do; and why it cannot move. */

import { html, useEffect, useState } from "../html.js";
import { Action, Panel, RefusalText } from "../parts/controls.js";
import { clock, words } from "../parts/format.js";
import { inPageTerms } from "../parts/remedies.js";
import { faultPage, Mark } from "../parts/state.js";
import { command, controls, question } from "../session/control.js";
import { moves, obstacle } from "../session/obstacles.js";

export function FaultPanel({ axis }) {
  const { faults } = axis;
  const first = axis.samples.fault?.first;
  return html`<div role="alert">
    ${
      faults.length > 0 &&
      html`<section class="faults" aria-label="Faults">
      <h2>${faults.length === 1 ? "Active fault" : `${faults.length} active faults`}</h2>
      ${
        first &&
        !faults.some((each) => each.code === first.code) &&
        html`<p>First fault:
        <a href=${faultPage(first.code)}>${words(first.code)}</a> at ${clock(first.since)}: ${first.text}.</p>`
      }
      <ul>${faults.map((fault) => html`<${FaultItem} fault=${fault} first=${first} />`)}</ul>
      ${
        axis.can("reset")
          ? html`<p class="row"><${Action} act=${() => command(axis, "reset")}
        obstacle=${obstacle(axis, "reset")}>Reset ${axis.name}<//></p>`
          : html`<p class="quiet">This drive is reset at the drive, not over its line.</p>`
      }
    </section>`
    }
  </div>`;
}

function FaultItem({ fault, first }) {
  return html`<li>
    <${Mark} level=${fault.stops ? "bad" : "warn"}>${fault.stops ? "stops the axis" : "warning"}<//>
    ${" "}<b>${words(fault.code)}</b>${first?.code === fault.code && html` <span class="quiet">first fault</span>`}
    <p>${fault.text}.</p>
    <p class="quiet">Since ${clock(fault.since)}, says the ${fault.source}.
      ${" "}<a href=${faultPage(fault.code)}>More about ${words(fault.code)}</a></p>
  </li>`;
}

/** What forbids any of its commands, each once. */
function waysOf(axis) {
  return [...new Set(Object.values(axis.samples.obstacles ?? {}).flatMap((causes) => causes.map(({ text }) => text)))];
}

/** Asks the daemon whenever something has changed that may change the answer. */
export function WhyPanel({ axis }) {
  const [why, setWhy] = useState(null);
  const [refusal, setRefusal] = useState(null);
  const { state } = axis;
  const mine = controls(axis);
  const [asked, setAsked] = useState(false);
  const isWanted = mine || asked;
  const situation = JSON.stringify([
    isWanted,
    state?.state,
    state?.moving,
    state?.motion_hidden_by,
    state?.stop_pending,
    state?.link,
    state?.stop_latched,
    state?.referenced,
    state?.enabled,
    state?.speed_override,
    axis.faults.map((each) => each.code),
    waysOf(axis), // an interlock is in no state
    axis.holder,
    mine,
    axis.rig.connected,
    axis.rig.worth?.word,
  ]);
  useEffect(() => {
    let wanted = true;
    if (!isWanted) return undefined;
    question(axis, "why").then(
      (reply) => wanted && (setWhy(reply), setRefusal(null)),
      (error) => wanted && setRefusal(error),
    );
    return () => {
      wanted = false;
    };
  }, [axis, situation]);

  if (!isWanted) {
    return html`<${Panel} title="Can it move?"><p class="row"><button type="button" onClick=${() => setAsked(true)}>Ask what is in its way</button></p><//>`;
  }
  return html`<${Panel} title="Can it move?">
    <div aria-live="polite">
      ${
        axis.rig.worth
          ? html`<p><${Mark} level="bad">not known<//> ${axis.rig.worth.why}</p>`
          : why &&
        !refusal &&
        (moves(axis) && why.causes.length === 1
          ? html`<p>It moves: the next motion waits for the end of this one, or halts it first.</p>`
          : why.can_move
          ? html`<p>Ready to move: a motion within the limits would be accepted.</p>`
          : html`<p>Not now. Clear in this order:</p><ol class="causes">${why.causes.map(
              (cause) => html`<li>
            <a href=${faultPage(cause.code)}>${words(cause.code)}</a> <span>${cause.text}.</span>
            ${cause.remedy && html`<p class="quiet">To clear it: ${inPageTerms(cause)}.</p>`}</li>`,
            )}</ol>`)
      }
      ${!axis.rig.worth && why?.first_fault && html`<p class="quiet">First fault since the last reset: ${why.first_fault}.</p>`}
    </div>
    <${RefusalText} refusal=${refusal} />
  <//>`;
}
