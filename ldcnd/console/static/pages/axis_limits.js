/** What an axis is limited to, its scale, and what its write-only registers hold. */

import { html } from "../html.js";
import { Facts, Panel, Table } from "../parts/controls.js";
import { number } from "../parts/format.js";
import { shownQuantity } from "../parts/number_text.js";
import { GAINS } from "../session/contract.js";
import { ProvenanceWord, registersDoubt } from "./axis_gains.js";

export function LimitsPanel({ axis }) {
  const { limits, unit, counts_per_unit: scale, direction, adc_full_scale: full } = axis.info;
  const limit = (value, dimension) => {
    const shown = shownQuantity(value, axis.info, dimension);
    return value === null ? "none" : html`${number(shown.value, 3)} <span class="unit">${shown.said}</span>`;
  };
  return html`<${Panel} title="Limits" of=${axis.rig} note="From the configuration of the daemon.">
    <${Facts} of=${[
      ["lowest position", limit(limits.position_min, "position")],
      ["highest position", limit(limits.position_max, "position")],
      ["velocity", limit(limits.velocity, "velocity")],
      ["acceleration", limit(limits.acceleration, "acceleration")],
      ["scale", scale ? `${scale} counts per ${unit}, ${direction}` : "none: it works in counts"],
      ["A/D full scale", full ?? "no A/D input"],
    ]} />
  <//>`;
}

export function RegistersPanel({ axis }) {
  const rows = axis.info.registers
    .filter(({ name }) => !(name in GAINS))
    .map(
      ({ name, value, provenance }) => html`<tr>
    <th scope="row">${name}</th><td class="number">${number(value, 0)}</td><td><${ProvenanceWord} provenance=${provenance} /></td></tr>`,
    );
  return html`<${Panel} title="Registers" of=${axis.rig} old=${registersDoubt(axis)}
    note="These drives cannot be read back: this is what the daemon knows of the rest of their registers.">
    <${Table} label=${`Registers of ${axis.name}`} head=${["Register", "#Raw value", "Known by"]} rows=${rows} />
  <//>`;
}
