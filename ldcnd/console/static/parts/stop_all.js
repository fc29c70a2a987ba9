/** The stop of every page: a button and a key, and what came of it. It is software, no emergency stop, and says so. */

import { html, useEffect, useState } from "../html.js";
import { askAtOnce, rigPath } from "../session/api.js";
import { clock } from "./format.js";

const KEY = "Escape";
const PATIENCE_MS = 6_000;

/** Stop one axis; past everything that waits. */
export function stopAxis(axis) {
  return askAtOnce(`${rigPath(axis.rig.name)}/stop`, { axis: axis.name }, { patienceMs: PATIENCE_MS });
}

/** The button, the key and the report. */
export function StopAll() {
  const [report, setReport] = useState(null);

  async function stop() {
    setReport({ at: Date.now() * 1e6, text: "Stop sent; waiting for the drives.", lines: [] });
    const at = Date.now() * 1e6;
    try {
      const { rigs } = await askAtOnce("/api/stop", {}, { patienceMs: PATIENCE_MS, keepalive: true });
      setReport({ at, lines: Object.entries(rigs).map(([rig, reply]) => outcome(rig, reply)) });
    } catch (error) {
      setReport({
        at,
        lines: [{ bad: true, text: `The stop did not get through: ${error.message} Use the emergency stop.` }],
      });
    }
  }

  useEffect(() => {
    const pressed = (event) => {
      if (event.key !== KEY || event.repeat) return;
      event.preventDefault();
      stop();
    };
    addEventListener("keydown", pressed, true);
    return () => removeEventListener("keydown", pressed, true);
  }, []);

  return html`<div class="stop-all">
    <button type="button" class="stop" aria-keyshortcuts=${KEY} onClick=${stop}>
      <b>Stop all axes</b> <kbd>Esc</kbd><small>software stop, not an emergency stop</small>
    </button>
    <div class="stop-report" role="alert" data-shown=${report ? "yes" : "no"}>
      ${
        report &&
        html`<p class="quiet">Stop at ${clock(report.at)}</p>
        ${report.text && html`<p>${report.text}</p>`}
        ${report.lines.map((line) => html`<p class="mark" data-level=${line.bad ? "bad" : ""}>${line.text}</p>`)}
        <button type="button" class="plain" onClick=${() => setReport(null)}>Dismiss</button>`
      }
    </div>
  </div>`;
}

function outcome(rig, reply) {
  if (!reply.axes) return { bad: true, text: `${rig}: not stopped: ${reply.message}. Use the emergency stop.` };
  const missing = reply.axes.filter((axis) => !reply.confirmed.includes(axis));
  const answered = reply.axes.filter((axis) => reply.confirmed.includes(axis));
  const confirmed = answered.length ? `confirmed by ${answered.join(", ")}` : "confirmed by no drive";
  if (!missing.length) return { bad: false, text: `${rig}: stopped and latched; ${confirmed}.` };
  return {
    bad: true,
    text: `${rig}: NOT confirmed by ${missing.join(", ")}; ${confirmed}. The latch holds; look at the machine.`,
  };
}
