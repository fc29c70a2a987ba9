/** Pages about one axis. Its name is in the address from the first moment, and no data that arrives change it. */

import { html, useEffect } from "../html.js";
import { absence, axesOf, axisNamed, useRigs } from "../session/rigs.js";
import { Choice } from "./controls.js";

/** A page about the axis that its address names, chosen among those that `can` says; `show` draws it.
 *
 * An address without an axis gets one as soon as any is known, before anything is shown of it. An axis that is not there,
 * or not any more, is said: another one in its place would be moved by a hand that meant this one.
 */
export function OneAxis({ at, page, title, can, none, show }) {
  useRigs();
  const axes = axesOf().filter((axis) => axis.info && can(axis));
  const first = at.axis === null ? (axes.find((axis) => axis.rig.connected) ?? axes[0]) : null;
  useEffect(() => {
    if (first) location.replace(addressOf(page, first));
  }, [first]);
  const named = axisNamed(at);
  const axis = axes.includes(named) ? named : null;
  if (!axes.length && at.axis === null) return html`<h1>${title}</h1><p>${none}</p>`;
  return html`<h1>${title}</h1>
    <div class="fields"><${Choice} label="Axis" options=${axes.map((each) => [nameOf(each), labelOf(each)])}
      value=${at.axis === null ? "" : `${at.rig}/${at.axis}`} missing=${at.axis === null ? "none yet" : `${at.rig} · ${at.axis}`}
      onChange=${(value) => {
        location.hash = `#/${page}/${value}`;
      }} /></div>
    ${axis ? html`<div key=${nameOf(axis)}>${show(axis)}</div>` : at.axis !== null && html`<${NotThere} at=${at} why=${named && none} />`}`;
}

/** Says that the axis of an address is not there; `why` where it is, and not for this page. */
export function NotThere({ at, why }) {
  return html`<p class="notice mark" role="status" data-level="warn">${why || absence(at)}</p>`;
}

const nameOf = (axis) => `${axis.rig.name}/${axis.name}`;
const labelOf = (axis) => `${axis.rig.name} · ${axis.name}`;
const addressOf = (page, axis) => `#/${page}/${nameOf(axis)}`;
