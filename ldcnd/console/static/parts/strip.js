/** An axis in one line that never leaves the screen: where it is and goes, its state, and what ends its motion. */

import { html, useState } from "../html.js";
import { command } from "../session/control.js";
import { obstacle } from "../session/obstacles.js";
import { titleOf } from "../session/rigs.js";
import { Action } from "./controls.js";
import { clock, decimalsOf, sentence } from "./format.js";
import { Homed, Place, placed, StateWord, TroubleWords } from "./state.js";
import { ifUnheard, stopAxis } from "./stop_all.js";

/** Where an axis is, and where it goes. */
export function PlaceAndTarget({ axis }) {
  const decimals = decimalsOf(axis.info);
  const target = axis.condition.live ? axis.state?.command?.target : null;
  return html`<span class="number"><${Place} axis=${axis} decimals=${decimals} />${target != null && html` <span class="quiet">→ ${placed(axis, target, decimals)}</span>`}</span>`;
}

/** The strip of the page of an axis. Anyone may end a motion, with or without control.
 *
 * What came of that is in the state of the axis. For a page to which nothing comes any more the answer is shown, until
 * the axis has told anything since.
 */
export function AxisStrip({ axis }) {
  const toHalt = obstacle(axis, "halt");
  const [told, setTold] = useState(null);
  const ends = (what, act, verb) => {
    const since = axis.state;
    const tell = (text, refused = false) => setTold({ text, refused, since });
    return {
      act: async () => {
        const at = clock(Date.now() * 1e6);
        axis.notePress();
        setTold(null); // what the press before was answered is no answer to this one
        tell(`${what} at ${at}: ${came(await act())}.`);
      },
      onRefused: ifUnheard(axis, verb, what, (error) => tell(`${what} refused: ${sentence(error.message)}`, true)),
    };
  };
  const isNews = told && (told.refused || (axis.rig.worth && told.since === axis.state));
  return html`<div class="strip of-axis">
    <span class="where"><b>${titleOf(axis)}</b> <${PlaceAndTarget} axis=${axis} /></span>
    <span><${StateWord} axis=${axis} /> <${Homed} axis=${axis} /><${TroubleWords} axis=${axis} /></span>
    ${axis.can("stop") && html`<span class="endings" role="group" aria-label=${`End a motion of ${axis.name}`}>
      <${Action} calms ...${ends("Halt", () => command(axis, "halt"), "halt")} obstacle=${toHalt} reason="halt-way"
        title=${toHalt ?? "Decelerate and hold; no latch"}>Halt<//><span class="unseen" id="halt-way">${toHalt ?? ""}</span>
      <${Action} calms ...${ends("Stop", () => stopAxis(axis), "stop")} kind="warn" title="Decelerate, hold, and latch until reset">Stop ${axis.name}<//>
      <${Action} calms ...${ends("Quick stop", () => command(axis, "quick_stop"), "quick_stop")} kind="warn"
        title="Hold at once, without a ramp, and latch until reset">Quick stop<//>
    </span>`}
    ${isNews && html`<span role=${told.refused ? "alert" : "status"} class=${told.refused ? "refusal" : null}>${told.text}</span>`}
  </div>`;
}

function came({ confirmed }) {
  if (!confirmed) return "the daemon has it";
  return confirmed.length ? `confirmed by ${confirmed.join(", ")}` : "confirmed by no drive";
}
