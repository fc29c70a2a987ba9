/** The stop of every page: a button and a key, and what came of it. It is software, no emergency stop, and says so. */

import { html } from "../html.js";
import { askAtOnce, Press, rigPath } from "../session/api.js";
import { commandOfMany } from "../session/control.js";
import { obstacle } from "../session/obstacles.js";
import { axesOf, changed, rigs, titleOf } from "../session/rigs.js";
import { Action, NoAnswerYet, useAtOnce } from "./controls.js";
import { clock, sentence } from "./format.js";

const KEY = "Escape";
const PATIENCE_MS = 6_000;

/** Stop one axis; past everything that waits. */
export function stopAxis(axis) {
  const answer = askAtOnce(`${rigPath(axis.rig.name)}/stop`, { axis: axis.name }, { patienceMs: PATIENCE_MS });
  axis.noteStop(answer.then(({ stops }) => stops?.[axis.name]));
  return answer;
}

/** What a motion has come to that an act was to end, or a motor that it was to switch off. */
const OVER = {
  halt: (axis) => axis.hasStoodSincePress,
  stop: (axis) => axis.isStopped,
  quick_stop: (axis) => axis.isStopped,
  disable: (axis) => axis.condition.live && axis.state?.enabled === false,
};
/** With these a daemon says that there is nothing to end, or what holds a load: all else may not have got through. */
const ANSWERED = new Set(["wrong_state", "interlock_violated", "not_supported"]);

/** What may not have got through of single axes. */
let unheard = [];

/** Return what to do with the failure of an act that takes energy out of an axis: a refusal is said where it was pressed.
 *
 * What may not have got through is said on every page, until the axis is seen to have come to it.
 */
export function ifUnheard(axis, act, what, refused = null) {
  return (error, show) => {
    if (ANSWERED.has(error.code)) return (refused ?? show)?.(error);
    const { instance } = axis.rig.daemon ?? {};
    // another daemon has other axes under the same name
    const rests = () => axis.rig.daemon?.instance !== instance && axis.condition.live && axis.state?.moving === "no";
    const said = `${what} of ${titleOf(axis)} ${notThrough(error)}`;
    sayUnheard(axis, act, said, () => rests() || OVER[act](axis));
  };
}

/** Return what is done with an answer to the halt of a whole rig, and with its failure: what may move on is said on
 * every page, until each axis that has not confirmed it, or was not known to stand, has stood since the press.
 */
export function ofRigHalt(rig, what) {
  const tell = (said, axes) => sayUnheard(rig, "halt", `${what} of ${rig.name} ${said}`, () => axes.length > 0 && axes.every(OVER.halt));
  return {
    onDone({ shortfall, halted, confirmed }) {
      if (shortfall) tell(shortfall, halted.filter((name) => !confirmed.includes(name)).map((name) => rig.axes.get(name)));
    },
    onRefused(error, show) {
      const moving = [...rig.axes.values()].filter((axis) => axis.info && axis.state?.moving !== "no");
      if (moving.length) tell(notThrough(error), moving);
      else show(error);
    },
  };
}

function notThrough(error) {
  return `did not get through: ${sentence(error.message)} Use the emergency stop.`;
}

function sayUnheard(whose, act, said, isOver) {
  unheard = unheard.filter((line) => line.whose !== whose || line.act !== act);
  unheard.push({ whose, act, text: `${clock(Date.now() * 1e6)}: ${said}`, isOver });
  changed();
}

/** What came of the last press of this page; null before the first, and once it is dismissed. */
let report = null;
let presses = 0;

function setReport(told) {
  report = told;
  changed();
}

function dismiss() {
  unheard = [];
  setReport(null);
}

async function stop() {
  const press = (presses += 1);
  const at = Date.now() * 1e6;
  setReport({ at, press, waits: true, lines: [] });
  const tell = (lines) => press === presses && setReport({ at, lines }); // the answer to a later press says more
  try {
    const answer = askAtOnce("/api/stop", {}, { patienceMs: PATIENCE_MS, keepalive: true });
    for (const axis of axesOf()) {
      axis.notePress();
      axis.noteStop(answer.then((told) => told.rigs[axis.rig.name]?.stops?.[axis.name]));
    }
    const { rigs: replies } = await answer;
    tell(Object.entries(replies).map(([rig, reply]) => outcome(rig, reply)));
  } catch (error) {
    tell([{ text: `The stop did not get through: ${sentence(error.message)} Use the emergency stop.`, level: "bad", isOver: () => rigs.size > 0 && [...rigs.values()].every(isStopped) }]);
  }
}

// from the first moment on, not only once something is drawn; what came before this module `early.js` has kept
removeEventListener("keydown", window.keepEarlyPress, true);
if (window.keepEarlyPress?.came) stop();
addEventListener("keydown", (event) => {
  if (event.key !== KEY || event.repeat) return;
  event.preventDefault();
  stop();
}, true);

/** The button. */
export function StopAll() {
  return html`<div class="stop-all">
    <button type="button" class="stop" aria-keyshortcuts=${KEY} ...${useAtOnce(stop)}>
      <b>Stop all axes</b> <kbd>Esc</kbd><small>software stop, not an emergency stop</small>
    </button>
  </div>`;
}

/** Outcome of a stop that no state of an axis shows yet; `Stops` shows the states, whichever client has stopped. */
export function StopReport() {
  // what a rig publishes now says more than what it answered then, and goes on to when it falls silent later
  if (report && !report.waits) report.lines = report.lines.filter((line) => !line.isOver?.());
  unheard = unheard.filter((line) => !line.isOver());
  const shown = Boolean(report?.waits || report?.lines.length || unheard.length);
  return html`<div class="stop-report" role="alert" data-shown=${shown ? "yes" : "no"}>
    ${
      shown &&
      html`${unheard.map((line) => html`<p class="mark" data-level="bad">${line.text}</p>`)}
      ${(report?.waits || report?.lines.length > 0) && html`<p class="quiet">Stop at ${clock(report.at)}</p>`}
      ${report?.waits && html`<p>Sent to the console.</p><${NoAnswerYet} key=${report.press} what="Stop all axes" />`}
      ${report?.lines.map((line) => html`<p class="mark" data-level=${line.level}>${line.text}</p>`)}
      <button type="button" class="plain" onClick=${dismiss}>Dismiss</button>`
    }
  </div>`;
}

function isStopped(rig) {
  const axes = [...(rig?.axes.values() ?? [])].filter((axis) => axis.info);
  return axes.length > 0 && !rig.worth && axes.every((axis) => axis.isStopped || (!axis.can("stop") && axis.condition.live && axis.state?.moving === "no"));
}

function outcome(rig, reply) {
  if (!reply.axes) {
    const text = `${rig}: not stopped: ${reply.message}. Use the emergency stop.`;
    return { level: "bad", text, isOver: () => isStopped(rigs.get(rig)) };
  }
  const text = [reply.shortfall, sentence(reply.outcome), reply.unreached, reply.warning].filter(Boolean).join(" ");
  // a state tells of it with the next value; without a latch none does
  const told = reply.outcome ? { isOver: () => rigs.get(rig)?.worth === null } : {};
  return { ...told, level: reply.shortfall ? "bad" : reply.warning && "warn", text: `${rig}: ${text}` };
}

/** The stops that are latched now, as the axes say it: by this page, another one, or any other program. */
export function Stops() {
  return [...rigs.values()].filter((rig) => !rig.worth).map((rig) => html`<${StopsOf} key=${rig.name} rig=${rig} />`);
}

function StopsOf({ rig }) {
  const axes = [...rig.axes.values()].filter((axis) => axis.info && axis.state?.stop_latched);
  const pending = axes.filter(({ state }) => state.stop_pending);
  const latched = axes.filter(({ state }) => !state.stop_pending);
  const unread = latched.filter(({ state }) => state.was_read === false);
  const read = latched.filter(({ state }) => state.was_read !== false);
  const stopped = read.filter((axis) => axis.isStopped);
  const moving = read.filter((axis) => axis.condition.live && axis.state.moving === "yes");
  const unseen = read.filter((axis) => !stopped.includes(axis) && !moving.includes(axis));
  if (!axes.length) return null;
  // what no stop reaches goes on beside the others where all of those were to stop
  const all = [...rig.axes.values()].filter((axis) => axis.info);
  const unreached = all.filter((axis) => !axis.can("stop"));
  const free = axes.length + unreached.length < all.length ? [] : unreached;
  const going = free.filter((axis) => !axis.condition.live || axis.state?.moving !== "no");
  const of = rigs.size > 1 ? `${rig.name}: ` : "";
  const ready = latched.filter((axis) => obstacle(axis, "reset") === null);
  const reset = () => {
    const pressed = new Press();
    return Promise.all(ready.map((axis) => commandOfMany(axis, "reset", {}, pressed)));
  };
  return html`<p class="notice mark stops" data-level=${pending.length || going.length || unseen.some(({ condition }) => !condition.live) ? "bad" : "warn"}>
    ${pending.length > 0 && html`<span>${of}stop NOT confirmed by ${named(pending)}: use the machine’s emergency stop.</span> `}
    ${moving.length > 0 && html`<span>${of}stop latched, moving still: ${named(moving)}.</span> `}
    ${unseen.length > 0 && html`<span>${of}stop latched, not seen to stand: ${named(unseen)}.</span> `}
    ${unread.length > 0 && html`<span>${of}stop latched, drive not read yet: ${named(unread)}.</span> `}
    ${stopped.length > 0 && html`<span>${of}stopped and latched: ${named(stopped)}.${axes.length < all.length ? "" : " Nothing moves before Reset."}</span> `}
    ${free.length > 0 && html`<span>No stop reaches ${named(free)}${going.length ? `; ${named(going)} may move: emergency stop` : ""}.</span> `}
    ${ready.length > 0 && html`<${Action} act=${reset}>Reset stopped axes<//>`}
  </p>`;
}

const MOST_NAMED = 8;

function named(axes) {
  const names = axes.slice(0, MOST_NAMED).map(({ name }) => name).join(", ");
  return axes.length > MOST_NAMED ? `${names} and ${axes.length - MOST_NAMED} more` : names;
}
