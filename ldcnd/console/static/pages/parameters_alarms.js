/** Alarms of a drive and its history, and what is not certain about the drive. */

import { html, useState } from "../html.js";
import { Action, Panel, Table } from "../parts/controls.js";
import { words } from "../parts/format.js";
import { Mark } from "../parts/state.js";
import { command } from "../session/control.js";
import { obstacle } from "../session/obstacles.js";

const LEVELS = { alarm: "bad", warning: "warn", unknown: "warn" };

export function AlarmPanel({ axis }) {
  const [report, setReport] = useState(null);
  const [profile, setProfile] = useState(null);
  return html`<${Panel} title="Alarms and doubts">
    <p class="row">
      <${Action} act=${() => command(axis, "read_alarms")} onDone=${setReport}
        obstacle=${obstacle(axis, "parameters")}>Read alarms<//>
      <${Action} act=${() => command(axis, "read_profile")} onDone=${setProfile}
        obstacle=${obstacle(axis, "none")}>Show doubts<//>
    </p>
    ${
      report &&
      html`<${Table} label="Alarms" head=${["When", "#Code", "Meaning", "Kind"]}
      rows=${[["now", report.present], ...report.history.map((entry, nth) => [`${nth + 1}`, entry])].map(
        ([when, entry]) => html`<tr>
        <th scope="row">${when}</th><td class="number">${entry.code.toString(16).toUpperCase().padStart(2, "0")}</td>
        <td>${entry.text}</td><td><${Mark}
          level=${when === "now" ? (LEVELS[entry.kind] ?? "") : ""}>${entry.kind}<//></td></tr>`,
      )} />`
    }
    ${
      profile &&
      html`<${Table} label="Doubts" head=${["Doubt", "What is assumed or asked", "Assumed", "From", "Standing"]}
      rows=${profile.doubts.map(
        (doubt) => html`<tr>
        <th scope="row">${words(doubt.key)}</th><td>${doubt.question}</td><td>${doubt.setting ?? "–"}</td><td>${doubt.confidence}</td>
        <td><${Mark} level=${doubt.standing === "contradicted" ? "bad" : ""}>${words(doubt.standing)}<//></td></tr>`,
      )} />`
    }
  <//>`;
}
