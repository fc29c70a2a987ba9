/** What was on a line lately, as the flight recorder kept it. */

import { html, useEffect, useRef, useState } from "../html.js";
import { save } from "../parts/chart_view.js";
import { Action, Choice, RefusalText } from "../parts/controls.js";
import { TextField } from "../parts/number_field.js";
import { dateAndClock } from "../parts/format.js";
import { ask, rigPath } from "../session/api.js";

const SPANS = [1, 5, 30, 300];
/** How long ago a moment may be for its packets to be looked for, in seconds. */
export const LONGEST_AGO_S = SPANS.at(-1);
/** What is shown before and after a moment, in seconds. */
const AROUND_S = 0.5;
const MOST_REPLIES = 40;
const MOST_SHOWN = 500;

export function WireLog({ rig, bus, instant }) {
  const [seconds, setSeconds] = useState(1);
  const [only, setOnly] = useState("");
  const [lines, setLines] = useState(null);
  const [refusal, setRefusal] = useState(null);
  const [moment, setMoment] = useState(instant);
  const here = useRef();
  useEffect(() => {
    if (!instant) return;
    here.current.scrollIntoView({ block: "center" });
    fetchAround(rig, bus, instant).then(setLines, setRefusal);
  }, [instant]);
  const latest = (fetched) => {
    setMoment(null);
    setLines(fetched);
  };
  const found = lines?.filter((line) => line.toLowerCase().includes(only.toLowerCase())) ?? [];
  return html`
    <div class="fields" ref=${here}>
      <${Choice} label="How far back" options=${SPANS.map((each) => [each, `${each} s`])} value=${seconds}
        onChange=${(value) => setSeconds(Number(value))} />
      <${TextField} label="Only lines with" type="search" value=${only || null} onChange=${(text) => setOnly(text ?? "")} />
    </div>
    <p class="row">
      <${Action} act=${() => fetchLog(rig, bus, seconds)} onDone=${latest}
        obstacle=${rig.worth && "No data from this rig."}>Fetch<//>
      <${Action} act=${() => save(new Blob([`${lines.join("\n")}\n`], { type: "text/plain" }), `${rig.name}-${bus}.log`)}
        obstacle=${lines ? null : "Fetch it first."}>Save to a file<//>
    </p>
    <${RefusalText} refusal=${refusal} />
    ${
      lines &&
      html`<p class="quiet" role="status">${moment ? `Around ${dateAndClock(moment)}: ` : ""}${found.length} records${found.length > MOST_SHOWN ? `, the last ${MOST_SHOWN} are shown` : ""}: seconds, event, bytes.</p>
      <pre class="scrolls" tabindex="0" role="region"
        aria-label=${`Wire log of ${rig.name} on ${bus}`}>${found.slice(-MOST_SHOWN).join("\n")}</pre>`
    }`;
}

/** Fetch what was on the line around a moment. */
async function fetchAround(rig, bus, instant) {
  const agoS = (rig.nowNs() - instant) / 1e9 || LONGEST_AGO_S; // of a daemon whose clock is not known yet
  return fetchLog(rig, bus, agoS + 2 * AROUND_S, instant);
}

/** Fetch reply after reply until there is no more, or it is enough; with an instant, only what is near it. */
async function fetchLog(rig, bus, seconds, instant = null) {
  const lines = [];
  let from = null;
  for (let count = 0; count < MOST_REPLIES; count += 1) {
    const reply = await ask(`${rigPath(rig.name)}/rig/wire_log`, {
      bus,
      seconds,
      ...(from !== null && { from_record: from }),
    });
    const offS = (line) => Number.parseFloat(line) - (instant - reply.zero) / 1e9;
    lines.push(...(instant ? reply.lines.filter((line) => Math.abs(offS(line)) <= AROUND_S) : reply.lines));
    if (instant && reply.lines.length && offS(reply.lines.at(-1)) > AROUND_S) break;
    if (reply.next_record >= reply.end_record || !reply.lines.length) break;
    from = reply.next_record;
  }
  return lines;
}
