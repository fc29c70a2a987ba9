/** The gains of a position loop: what they are, how that is known, and new ones, written by a click only. */

import { html, useId, useState } from "../html.js";
import { Action, Panel, Reason, Table } from "../parts/controls.js";
import { number, words } from "../parts/format.js";
import { NumberField, unread } from "../parts/number_field.js";
import { Unread } from "../parts/number_text.js";
import { Mark } from "../parts/state.js";
import { GAINS } from "../session/contract.js";
import { command } from "../session/control.js";
import { obstacle } from "../session/obstacles.js";
import { describeSoon } from "../session/rigs.js";

/** The registers of an axis that are gains, by name. */
export function gainsOf(axis) {
  return Object.fromEntries(axis.info.registers.filter(({ name }) => name in GAINS).map((each) => [each.name, each]));
}

/** How a register's value is known, in words. */
export function ProvenanceWord({ provenance }) {
  const level = { written_and_acknowledged: "", assumed: "warn" }[provenance] ?? "bad";
  return html`<${Mark} level=${level}>${words(provenance)}<//>`;
}

/** Why the daemon may be wrong about registers that cannot be read; null while nothing tells so. */
export function registersDoubt(axis) {
  return axis.condition.live ? null : "the drive does not answer; without power it has forgotten them.";
}

export function GainsPanel({ axis }) {
  return html`<${Panel} title="Gains" of=${axis.rig} old=${registersDoubt(axis)} note="Register values as in the drive's manual. Nothing is written without a click.">
    <${GainsTable} axis=${axis} />
  <//>`;
}

/** Present and new gains; `wanted` and `onWanted` let a page fill the new ones in. */
export function GainsTable({ axis, wanted: given, onWanted }) {
  const own = useState({});
  const [wanted, setWanted] = onWanted ? [given, onWanted] : own;
  const reason = useId();
  const gains = gainsOf(axis);
  const changes = Object.fromEntries(
    Object.entries(wanted).filter(([name, value]) => value !== null && value !== gains[name]?.value),
  );
  const count = Object.keys(changes).length;
  const way = obstacle(axis, "set_gains") ?? unread(wanted) ?? (count ? null : "No new value differs from the present one.");

  const rows = Object.values(gains).map(
    ({ name, value, provenance }) => html`<tr key=${name}>
    <th scope="row">${name} <small>${GAINS[name].title}</small></th>
    <td class="number">${number(value, 0)} <small><${ProvenanceWord} provenance=${provenance} /></small></td>
    <td><${NumberField} plain label=${`New ${name}`} whole min=${GAINS[name].min} max=${GAINS[name].max}
      value=${wanted[name]} onChange=${(value) => setWanted((last) => ({ ...last, [name]: value }))}
      hint=${`${GAINS[name].min} to ${GAINS[name].max}`} /></td>
  </tr>`,
  );

  async function write() {
    await command(axis, "set_gains", changes);
    setWanted({});
    describeSoon();
  }

  return html`<${Table} label=${`Gains of ${axis.name}`} kind="gains" head=${["Register", "#Present", "New"]}
    rows=${rows} />
    <p class="row"><${Action} act=${write} obstacle=${way} reason=${reason} kind="main">
      ${
        count
          ? `Write ${Object.entries(changes)
              .map(([name, value]) => `${name} = ${value instanceof Unread ? "?" : value}`)
              .join(", ")}`
          : "Write gains"
      }<//></p>
    ${way && html`<${Reason} id=${reason} text=${way} />`}`;
}
