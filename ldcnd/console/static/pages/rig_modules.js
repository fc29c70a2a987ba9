/** The PIC-I/O modules of a line on the rig page: what their named lines say, one module after the other. */

import { html } from "../html.js";
import { Facts } from "../parts/controls.js";
import { readingOf } from "../parts/module_reading.js";
import { Mark } from "../parts/state.js";

export function ModulesOf({ rig, bus }) {
  const named = (bus.info?.modules ?? []).filter((module) => module.name);
  return named.map(({ name }) => html`<${ModuleLine} key=${name} rig=${rig} name=${name} />`);
}

function ModuleLine({ rig, name }) {
  const { named, known } = readingOf(rig, name);
  const troubles = rig.worth ? [] : rig.axis(name).condition.troubles;
  return html`<section class="module" aria-label=${`Module ${name}`} data-stale=${known ? "no" : "yes"}>
    <h3><a href="#/network">${name}</a></h3>
    ${troubles.map(({ level, text }) => html`<${Mark} level=${level}>${text}<//>`)}
    ${named.length ? html`<${Facts} of=${named} />` : html`<span class="quiet">none of its lines has a name</span>`}
  </section>`;
}
