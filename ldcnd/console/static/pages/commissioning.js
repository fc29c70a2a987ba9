/** Commissioning: from a port of which nothing is known to axes that are measured, tuned and written down. */

import { html, useEffect, useMemo, useState } from "../html.js";
import { ChartView } from "../parts/chart_view.js";
import { Panel, RefusalText, Table } from "../parts/controls.js";
import { TextField } from "../parts/number_field.js";
import { Curve } from "../parts/curve.js";
import { CopiedCommand, Lines, QuestionPart } from "../parts/person.js";
import { Mark } from "../parts/state.js";
import { Conversation, followOverview } from "../session/commissioning.js";
import { look } from "../session/channels.js";

const LEVELS = { done: "", skipped: "", "not needed": "", "not possible": "", failed: "bad", open: "warn" };
const WHO = "commissioning-by";

export function CommissioningPage({ at }) {
  const [overview, setOverview] = useState(null);
  const [refusal, setRefusal] = useState(null);
  useEffect(
    () =>
      followOverview((told, error) => {
        if (told) setOverview(told);
        setRefusal(error);
      }),
    [],
  );
  if (!overview) return html`<h1>Commissioning</h1><${RefusalText} refusal=${refusal} />`;
  if (at.axis) return html`<${AxisChecklist} key=${at.axis} name=${at.axis} overview=${overview} />`;
  return html`<h1>Commissioning</h1>
    <p class="quiet">The configuration is <code>${overview.file}</code>. What you agree to is written into it; what was found out is
      kept beside it. The emergency stop of the machine stays within reach: this is software.</p>
    <${RefusalText} refusal=${refusal} />
    <${Search} overview=${overview} />
    ${overview.rig && html`<${Daemon} overview=${overview} /><${Axes} overview=${overview} />`}`;
}

/** A conversation for as long as a part of the page is there. */
function useConversation(path) {
  const [, setCount] = useState(0);
  const [talk, setTalk] = useState(null);
  useEffect(() => {
    const opened = new Conversation(path, () => setCount((count) => count + 1));
    setTalk(opened);
    return () => opened.close();
  }, [path]);
  return talk;
}

function Search({ overview }) {
  const [open, setOpen] = useState(false);
  const step = overview.rig ? "Search for more drives" : "1. Search for drives";
  return html`<${Panel} title=${step} note="Listens and reads on a port that no daemon has: nothing moves, nothing is reset. Only when you agree are addresses given.">
    ${overview.problem && html`<p class="mark" data-level="bad">${overview.problem}</p>`}
    ${open ? html`<${FileTalk} begin="scan" title="Search" again="Search again" />` : html`<p class="row"><button type="button" class=${overview.rig ? "" : "main"} onClick=${() => setOpen(true)}>Search a port</button></p>`}
  <//>`;
}

/** What concerns the configuration as a whole: the search for drives, and a reload by the daemon. */
function FileTalk({ begin, title, again }) {
  const talk = useConversation("scan");
  useEffect(() => {
    if (talk?.view && !talk.begun) {
      talk.begun = true;
      talk.begin(begin, "");
    }
  }, [talk?.view]);
  if (!talk?.view) return html`<${Away} talk=${talk} />`;
  const { view } = talk;
  return html`<${Activity} talk=${talk} title=${title} />
    ${!view.running && html`<p class="row"><button type="button" onClick=${() => talk.begin(begin, "")}>${again}</button></p>`}`;
}

function Daemon({ overview }) {
  const [open, setOpen] = useState(false);
  const text = overview.connected
    ? `The daemon of rig ${overview.rig} runs.`
    : `No daemon serves rig ${overview.rig} yet. Start it in a terminal of the machine that has the port; this page notices by itself.`;
  return html`<${Panel} title="2. The daemon" note="Nothing moves when it starts. A reload shows first what it would change; what needs a restart is named: end the daemon then, and start it again with the same command.">
    <p role="status" class="mark" data-level=${overview.connected ? null : "warn"}>${text}</p>
    <${CopiedCommand} command=${overview.command} />
    ${overview.connected && (open ? html`<${FileTalk} begin="reload" title="Reload" again="Reload again" />` : html`<p class="row"><button type="button" onClick=${() => setOpen(true)}>Reload the configuration</button></p>`)}
  <//>`;
}

function Axes({ overview }) {
  const rows = overview.axes.map(
    ({ axis, model, open, tuned, page }) => html`<tr key=${axis}>
      <th scope="row"><a href=${`#/commissioning/${encodeURIComponent(overview.rig)}/${encodeURIComponent(axis)}`}>${axis}</a></th>
      <td>${model}</td><td>${tuned ? "tuned" : html`<${Mark} level="warn">not tuned<//>`}</td>
      <td>${open.join(", ") || "nothing"}</td><td>${page ?? ""}</td></tr>`,
  );
  return html`<${Panel} title="3. The axes" note="Each axis has a checklist. For tuning it needs two steps: unit, scale and first gains; then motor against encoder.">
    <${Table} label="Axes of the configuration" head=${["Axis", "Model", "Gains", "Open", "On a page"]} rows=${rows} />
  <//>`;
}

function AxisChecklist({ name, overview }) {
  const talk = useConversation(`axes/${encodeURIComponent(name)}`);
  const [by, setBy] = useState(sessionStorage.getItem(WHO) ?? "");
  function named(text) {
    setBy(text ?? "");
    sessionStorage.setItem(WHO, text ?? "");
  }
  const heading = html`<header class="title"><h1><a href="#/commissioning">Commissioning</a> <span class="quiet">/</span> ${name}</h1>
    <p class="links"><a href=${`/api/commissioning/axes/${encodeURIComponent(name)}/report`} download>Report</a></p></header>`;
  if (!talk?.view) return html`${heading}<${Away} talk=${talk} />`;
  const { view } = talk;
  const running = view.steps.find((step) => step.name === view.running);
  return html`${heading}
    ${!overview.connected && html`<${Daemon} overview=${overview} />`}
    <${Activity} talk=${talk} title=${running?.title ?? "Last step"} overview=${overview} />
    <${Panel} title="Checklist" note="In this order the steps build on each other. Leave whenever you like: what is settled stays.">
      <div class="fields"><${TextField} label="Your name, for the report" value=${by || null} onChange=${named} maxlength="64" /></div>
      ${view.running && html`<p class="reason">${running?.title} is going on; the others wait.</p>`}
      <ol class="checklist">
        ${view.steps.map((step) => html`<${Step} key=${step.name} step=${step} talk=${talk} by=${by} />`)}
      </ol>
    <//>
    ${view.curves?.length > 0 && html`<${TestMoves} name=${name} view=${view} />`}`;
}

function Step({ step, talk, by }) {
  const busy = Boolean(talk.view.running);
  return html`<li>
    <h3>${step.title} <small><${Mark} level=${LEVELS[step.state]}>${step.state}<//></small></h3>
    <p class="quiet">${step.about}</p>
    ${step.text && html`<p>${step.text}${step.at && html` <span class="quiet">${step.by}, ${step.at}</span>`}</p>`}
    ${!step.obstacle && html`<p class="row"><button type="button" aria-disabled=${busy ? "true" : null}
      onClick=${() => busy || talk.begin(step.name, by)}>${step.state === "open" ? "Begin" : "Repeat"}: ${step.title}</button></p>`}
  </li>`;
}

/** What goes on: what was said, what is asked, and why it has failed. */
function Activity({ talk, title, overview }) {
  const { view } = talk;
  if (!view.running && !view.lines?.length && !view.problem) return null;
  return html`<${Panel} title=${title}>
    ${view.lines?.length > 0 && html`<${Lines} lines=${view.lines} />`}
    <${QuestionPart} talk=${talk} />
    ${view.running && !view.question && html`<p role="status">It is going on …</p>`}
    ${view.running && html`<p class="row"><button type="button" onClick=${() => talk.leave()}>End this step</button>
      <span class="quiet">What moves is halted; the step stays open.</span></p>`}
    <${RefusalText} refusal=${view.problem} />
    ${!view.running && html`<p role="status">It has ended.</p>`}
    ${!view.running && overview && html`<${CopiedCommand} command=${overview.command} />`}
  <//>`;
}

function Away({ talk }) {
  if (talk?.refused) return html`<${Panel} title="Not on this page"><${RefusalText} refusal=${talk.refused} /><//>`;
  return html`<p class="quiet" role="status">Connecting …</p>`;
}

function TestMoves({ name, view }) {
  const curves = useMemo(
    () =>
      view.curves.flatMap(({ label, times_s: times, positions, following_errors: errors }, nth) => {
        const xs = Float64Array.from(times);
        const drawn = { unit: view.unit, ...look(nth) };
        const lag = { pane: "following error", ...drawn, label: `${label}: following error`, xs };
        return [
          new Curve({ ...drawn, label, xs, ys: Float64Array.from(positions) }),
          new Curve({ ...lag, ys: Float64Array.from(errors) }),
        ];
      }),
    [view.curves.map((curve) => `${curve.label} ${curve.times_s.length} ${curve.positions.at(-1)}`).join()],
  );
  return html`<${Panel} title="Test moves" note="Measured beside predicted.">
    <${ChartView} name=${`tuning ${name}`} curves=${curves} height=${320} /><//>`;
}
