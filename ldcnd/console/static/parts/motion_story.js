/** What became of a motion, in the words of a person: where the axis came to rest, and why there. */

import { html } from "../html.js";
import { clock, decimalsOf, duration, number, words } from "./format.js";
import { Mark, placed } from "./state.js";

/** How late an event that a command has ended may be, ms. */
const LATE_MS = 3_000;
/** What this page has sent and asked once more for the end of. */
const askedAgain = new WeakSet();
const ENDINGS = { halt: "halted", stop: "stopped", quick_stop: "stopped" };

/** An ordinary end in words, with the client whose command it was; null for any other reason of an event. */
export function ordinary(reason) {
  const [, verb, client] = /^aborted by (halt|stop|quick_stop)(?: of ([^:]+))?$/.exec(reason ?? "") ?? [];
  return verb ? `${ENDINGS[verb]}${client ? ` by ${client}` : ""}` : null;
}

/** How a motion ended; `event` is its last event. */
export function EndOfMotion({ axis, event }) {
  const { status, verb, reason, following_error: off, settled } = event;
  const sameUnit = event.t >= (axis.unitChange?.since ?? 0);
  const position = restOf(axis, event);
  const decimals = decimalsOf(axis.info);
  const last = sameUnit ? event.last_position : null;
  const shown = position ?? last;
  const place = shown == null ? ""
    : html`${position == null ? ", last read" : ""} at ${placed(axis, shown, decimals)} <span class="unit">${axis.info.unit}</span>`;
  const goal = event.target ?? (settled == null || off == null || position == null ? null : position + off);
  const target = goal == null || !sameUnit ? "" : ` to ${placed(axis, goal, decimals)}`;
  const at = html` <span class="quiet">${clock(event.t).slice(0, -4)}</span>`;
  if (status === "done") {
    const tookS = axis.settlingS(event);
    const rest = settled === false
      ? html`, <${Mark} level="warn">NOT settled, ${number(off, decimals)} off<//>`
      : settled && tookS !== null ? `, settled in ${duration(tookS)}` : settled ? ", settled" : "";
    return html`${words(verb)}${target}:${place || " done"}${rest}${at}`;
  }
  if (status === "aborted") return html`${words(verb)}${target}, ${ordinary(reason) ?? `ended, ${reason}`}${place}${at}`;
  return html`${words(verb)}${target} <${Mark} level="bad">${status}<//>${place}: ${reason}${at}`;
}

/** Where a motion came to rest; null while that is not known. One that was cut off is still moving at its own end. */
function restOf(axis, event) {
  if (event.t < (axis.unitChange?.since ?? 0)) return null; // it was in another unit
  if (event.position != null) return event.position;
  const after = axis.rig.events.slice(axis.rig.events.indexOf(event) + 1).filter((each) => each.axis === axis.name);
  if (after.some(({ verb }) => verb === "set_position")) return null; // what came behind it is in other coordinates
  const ending = after.find((each) => each.position != null);
  if (ending) return axis.rig.mayMove(ending.verb) ? null : ending.position;
  // where it ended before a restart of the daemon or the loss of its reference is not known any more
  const since = event.t >= (axis.rig.daemon?.started ?? Infinity) && axis.condition.live && axis.condition.known;
  return since && axis.state?.moving === "no" && axis.ended() === event ? (axis.samples.position?.value ?? null) : null;
}

/** Whether a command is over although no event has said so: one may have been lost, and is asked for once. */
export function isOverUnsaid(axis, sent, atMs) {
  const isOver = axis.state?.command?.command_id !== sent.command_id && performance.now() - atMs > LATE_MS && !sent.waits_for;
  if (isOver && !askedAgain.has(sent)) {
    askedAgain.add(sent);
    axis.rig.caughtUp = null;
  }
  return isOver;
}

/** What becomes of a command that this page has sent; `sent` is its reply, with the run of the daemon it was sent to, and when. */
export function StoryOf({ axis, sent }) {
  const { state, rig } = axis;
  const ended = axis.ended(sent.command_id);
  if (ended) return html`<${EndOfMotion} axis=${axis} event=${ended} />`;
  const to = sent.position == null || sent.ends ? "" : ` to ${placed(axis, sent.position, decimalsOf(axis.info))} ${axis.info.unit}`;
  if (rig.worth) return html`${words(sent.verb)}${to}: <${Mark} level="bad">not known how far it is.<//> ${rig.worth.why}`;
  if (rig.daemon?.instance !== sent.run) return html`${words(sent.verb)}: <${Mark} level="warn">not known how it ended<//>, the daemon was started again.`;
  if (state?.command?.command_id === sent.command_id) return `${axis.name} ${sent.ends ?? `moves${to}`}.`;
  if (isOverUnsaid(axis, sent, sent.atMs)) return html`${words(sent.verb)}${to}: <${Mark} level="warn">over, how it ended is under Events<//>.`;
  return `Accepted: ${words(sent.verb)}${to}.`;
}
