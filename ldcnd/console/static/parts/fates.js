/** What was asked of several axes at once, and what became of it on each: shown until something else is asked. */

import { html } from "../html.js";
import { changed } from "../session/rigs.js";
import { clock } from "./format.js";
import { isOverUnsaid, ordinary } from "./motion_story.js";
import { Mark } from "./state.js";

const LEVELS = { aborted: "warn", failed: "bad", unknown: "bad", refused: "bad" };
/** By where it was asked; a page that is left and opened again still says it. */
const asked = new Map();

/** Ask something of axes and keep what becomes of it; `send` takes an axis and returns the reply to its command.
 *
 * Returns the axes that refused it, each with its error.
 */
export async function askEach(place, title, axes, send) {
  const parts = axes.map((axis) => ({ axis, run: axis.rig.daemon?.instance, sent: null, error: null, atMs: 0 }));
  asked.set(place, { title, rig: axes[0].rig, atMs: performance.now(), parts });
  changed();
  await Promise.all(
    parts.map(async (part) => {
      try {
        part.sent = await send(part.axis);
      } catch (error) {
        part.error = error;
      }
      part.atMs = performance.now();
      changed();
    }),
  );
  return parts.filter(({ error }) => error);
}

/** What became of it, axis by axis, as far as that is known now. */
export function Fates({ place }) {
  const { title, rig, atMs, parts } = asked.get(place) ?? {};
  const alike = new Map();
  for (const part of parts ?? []) {
    const { level, text } = fateOf(part);
    const key = `${level} ${text}`;
    if (!alike.has(key)) alike.set(key, { level, text, names: [] });
    alike.get(key).names.push(part.axis.name);
  }
  return html`<p class="told" role="status">${parts?.length > 0 && html`${title} at ${clock(rig.nsAt(atMs)).split(".")[0]}: ${[...alike.values()].map(
    ({ level, text, names }, at) => html`${at > 0 && "; "}<${Mark} level=${level}>${names.join(", ")} ${text}<//>`)}.`}</p>`;
}

function fateOf(part) {
  const { axis, run, sent, error, atMs } = part;
  const { rig } = axis;
  if (error) return { level: "bad", text: `${error.code ? "refused" : "not known"}: ${error.message.replace(`axis ${axis.name}: `, "")}` };
  if (!sent) return { level: "", text: "sent" };
  const event = axis.ended(sent.command_id);
  if (event?.status === "done") return event.settled === false ? { level: "warn", text: "done, NOT settled" } : { level: "", text: "done" };
  if (event) return { level: LEVELS[event.status] ?? "", text: ordinary(event.reason) ?? `${event.status}: ${event.reason}` };
  if (rig.worth) return { level: "bad", text: "not known how far it is" };
  if (rig.daemon?.instance !== run) return { level: "warn", text: "not known how it ended, the daemon was started again" };
  return isOverUnsaid(axis, sent, atMs) ? { level: "warn", text: "over, how it ended is under Events" } : { level: "", text: "under way" };
}
