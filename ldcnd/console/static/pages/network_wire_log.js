/** What was on a line lately, as the flight recorder kept it. */

import { html, useState } from "../html.js";
import { save } from "../parts/chart_view.js";
import { Action, Choice } from "../parts/controls.js";
import { TextField } from "../parts/number_field.js";
import { ask, rigPath } from "../session/api.js";

const SPANS = [1, 5, 30, 300];
const MOST_REPLIES = 40;
const MOST_SHOWN = 500;

export function WireLog({ rig, bus }) {
  const [seconds, setSeconds] = useState(1);
  const [only, setOnly] = useState("");
  const [lines, setLines] = useState(null);
  const found = lines?.filter((line) => line.toLowerCase().includes(only.toLowerCase())) ?? [];
  return html`
    <div class="fields">
      <${Choice} label="How far back" options=${SPANS.map((each) => [each, `${each} s`])} value=${seconds}
        onChange=${(value) => setSeconds(Number(value))} />
      <${TextField} label="Only lines with" type="search" value=${only || null} onChange=${(text) => setOnly(text ?? "")} />
    </div>
    <p class="row">
      <${Action} act=${() => fetchLog(rig, bus, seconds)} onDone=${setLines}
        obstacle=${rig.worth && "No data from this rig."}>Fetch<//>
      <${Action} act=${() => save(new Blob([`${lines.join("\n")}\n`], { type: "text/plain" }), `${rig.name}-${bus}.log`)}
        obstacle=${lines ? null : "Fetch it first."}>Save to a file<//>
    </p>
    ${
      lines &&
      html`<p class="quiet" role="status">${found.length} records${found.length > MOST_SHOWN ? `, the last ${MOST_SHOWN} are shown` : ""}: seconds, event, bytes.</p>
      <pre class="scrolls" tabindex="0" role="region"
        aria-label=${`Wire log of ${rig.name} on ${bus}`}>${found.slice(-MOST_SHOWN).join("\n")}</pre>`
    }`;
}

/** Fetch reply after reply until there is no more, or it is enough. */
async function fetchLog(rig, bus, seconds) {
  const lines = [];
  let from = null;
  for (let count = 0; count < MOST_REPLIES; count += 1) {
    const reply = await ask(`${rigPath(rig.name)}/rig/wire_log`, {
      bus,
      seconds,
      ...(from !== null && { from_record: from }),
    });
    lines.push(...reply.lines);
    if (reply.next_record >= reply.end_record || !reply.lines.length) break;
    from = reply.next_record;
  }
  return lines;
}
