/** The ports of a line: which program is there, what it controls, how much it asks; and a button to send it away. */

import { html } from "../html.js";
import { Action, Table } from "../parts/controls.js";
import { dateAndClock, number } from "../parts/format.js";
import { ofRig } from "../session/control.js";

export function Guests({ rig, bus }) {
  const guests = bus.health?.guests ?? [];
  if (!guests.length) return null;
  const rows = guests.map(
    (guest) => html`<tr key=${guest.port}><th scope="row">${guest.port}</th>
    <td>${guest.problem || (guest.since === null ? "no program" : dateAndClock(guest.since))}</td>
    <td>${guest.axes.join(", ") || "nothing"}</td>
    <td class="number">${number(guest.packets_hz, 1)}</td><td class="number">${guest.refused}</td>
    <td>${
      guest.since === null
        ? null
        : html`<${Action} of=${guest.since} act=${() => ofRig(rig, "send_guest_away", { port: guest.port })}>Send ${guest.port} away<//>`
    }</td></tr>`,
  );
  return html`<h3>Ports</h3>
    <${Table} label=${`Ports of ${rig.name} on ${bus.name}`}
      head=${["Port", "Program since", "Controls", "#Packets/s", "#Refused", "Commands"]} rows=${rows} />
    <p class="quiet">A program that is sent away loses its terminal or connection; axes that it moves do what their configuration says for the loss of a client.</p>`;
}
