/** Alarms of a drive and its history, and its counters. */

import { html, useState } from "../html.js";
import { Action, Panel, Table } from "../parts/controls.js";
import { clock } from "../parts/format.js";
import { Mark } from "../parts/state.js";
import { client, command } from "../session/control.js";
import { obstacle } from "../session/obstacles.js";

const LEVELS = { alarm: "bad", warning: "warn", unknown: "warn" };

export function AlarmPanel({ axis }) {
  const [report, setReport] = useState(null);
  const [cleared, setCleared] = useState(null);
  const read = async () => {
    const at = axis.now();
    return { ...(await command(axis, "read_alarms")), at };
  };
  return html`<${Panel} title="Alarms and counters" of=${axis.rig} old=${report && axis.doubt(report.at, client)}>
    <p class="row">
      <${Action} act=${read} onDone=${setReport}
        obstacle=${obstacle(axis, "parameters")}>Read alarms<//>
      ${report && html`<span class="quiet">Read at ${clock(axis.rig.nsAt(report.at.atMs)).slice(0, -4)}.</span>`}
    </p>
    <p class="row">${["command", "feedback"].map(
      (counter) => html`<${Action} act=${() => command(axis, "clear_counter", { counter })} onDone=${setCleared}
        obstacle=${obstacle(axis, "write_parameter")}>Clear the ${counter} counter<//>`,
    )}</p>
    ${
      cleared &&
      html`<p role="status">The ${cleared.counter} counter reads ${cleared.value}. ${cleared.remarks.join(" ")}</p>`
    }
    ${
      report &&
      html`<${Table} label="Alarms" head=${["When", "#Code", "Meaning", "Kind"]}
      rows=${[["now", report.present], ...report.history.map((entry, nth) => [`${nth}`, entry])].map(
        ([when, entry]) => html`<tr>
        <th scope="row">${when}</th><td class="number">${entry.code.toString(16).toUpperCase().padStart(2, "0")}</td>
        <td>${entry.text}</td><td><${Mark}
          level=${when === "now" ? (LEVELS[entry.kind] ?? "") : ""}>${entry.kind}<//></td></tr>`,
      )} />`
    }
  <//>`;
}
