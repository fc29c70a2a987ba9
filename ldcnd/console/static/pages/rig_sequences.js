/** Sequences and named positions of a rig: what they do, what forbids them now, and how far the one is that runs. */

import { html } from "../html.js";
import { Action, Panel, RefusalText, useOnce } from "../parts/controls.js";
import { clock, sentence } from "../parts/format.js";
import { askAtOnce, rigPath } from "../session/api.js";
import { client, ofRun, stopsOf } from "../session/control.js";
import { hindrance } from "../session/obstacles.js";

const STOP_PATIENCE_MS = 6_000;
const PRESS = { sequence: "Run", position: "Go" };
const LEVELS = { failed: "bad", stopped: "warn" };

/** A panel, where the rig has any. */
export function Sequences({ rig }) {
  const { runnables, problem } = rig.canRun;
  if (!runnables.length && !problem) return null;
  const positions = runnables.some(({ kind }) => kind === "position");
  return html`<${Panel} title="Sequences and positions" of=${rig}>
    ${problem && html`<p class="mark" data-level="warn">The sequences of this daemon cannot be read: ${sentence(problem)}</p>`}
    <${Progress} rig=${rig} />
    <ul class="runnables">${runnables.map((each) => html`<${Runnable} key=${`${each.kind} ${each.name}`} rig=${rig} of=${each} />`)}</ul>
    ${positions && html`<p class="quiet">Positions are taught on the command line: <code>ldcnd position teach</code>.</p>`}
  <//>`;
}

/** How far the run is, or the last one was, and what ends it. */
function Progress({ rig }) {
  const { run } = rig;
  const goes = rig.runs;
  const stop = () => askAtOnce(`${rigPath(rig.name)}/run/stop`, {}, { patienceMs: STOP_PATIENCE_MS, keepalive: true });
  const pause = () => ofRun(rig, "run/pause", { on: !run.paused });
  const notMine = run?.client !== client && `It is run by ${run?.client}: go there, or stop it here.`;
  return html`<div class="run">
    <p class="mark" role="status" data-level=${LEVELS[run?.end] ?? null}>${run && inWords(run)}</p>
    ${run?.error && html`<p><${RefusalText} refusal=${{ ...run.error, rig: rig.name }} /></p>`}
    ${goes && html`<p class="row">
      <${Action} key="stop" kind="main" act=${stop} calms=${true} title="What moves is halted; outputs stay as they are">Stop ${run.name}<//>
      <${Action} key="pause" act=${pause} obstacle=${notMine || null}
        title="A motion under way goes on; the next step waits">${run.paused ? "Go on" : "Pause"}<//>
    </p>`}
  </div>`;
}

function inWords({ kind, name, step, of, title, since, waits, paused, end, ended, client: who }) {
  const what = `${kind} ${name}`;
  const where = step ? `step ${step} of ${of}, ${title}` : "";
  const at = (ns) => clock(ns).split(".")[0];
  if (end === "done") return `${what}: done at ${at(ended)}.`;
  if (end) return `${what}: ${end} at ${at(ended)}${where && `, in ${where}`}.`;
  if (!step) return `${what}: begins, for ${who}.`;
  if (waits) return `${what}: paused since ${at(since)} before ${where}.`;
  return `${what}: ${where}, since ${at(since)}${paused ? "; then it waits" : ""}.`;
}

function Runnable({ rig, of: each }) {
  const { kind, name, steps, mark, axes } = each;
  const once = useOnce();
  const isThis = rig.run?.kind === kind && rig.run?.name === name;
  const at = isThis && rig.runs ? rig.run.step : 0;
  const body = { kind, name, mark };
  const way = wayOf(rig, each) ?? once.obstacle(body, false);
  const stops = () => stopsOf(axes.map((axis) => rig.axis(axis)));
  const begin = async (pressed) => ofRun(rig, "run", { ...body, after_stops: await stops() }, pressed);
  const run = () => once.send(body, false, begin);
  return html`<li aria-label=${`${kind} ${name}`}>
    <h3>${name}</h3>
    ${kind === "position"
      ? html`<p>${steps[0]}</p>`
      : html`<ol>${steps.map((step, index) => html`<li aria-current=${index + 1 === at ? "step" : null}>${step}</li>`)}</ol>`}
    <${Action} act=${run} obstacle=${way} of=${isThis ? rig.run?.ended : null}>${PRESS[kind]} ${name}<//>
  </li>`;
}

/** What forbids to run it now, in words; null where nothing does. */
function wayOf(rig, { axes, first }) {
  if (rig.runs) return `The ${rig.run.kind} ${rig.run.name} runs: stop it, or wait for its end.`;
  for (const name of axes) {
    const way = hindrance(rig.axis(name), null);
    if (way) return axes.length > 1 ? `${name}: ${way}` : way;
  }
  for (const { axis, verb, waits } of first) {
    const way = hindrance(rig.axis(axis), verb, waits);
    if (way) return axes.length > 1 ? `${axis}: ${way}` : way;
  }
  return null;
}
