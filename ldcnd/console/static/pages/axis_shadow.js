/** What an observer, such as `ldcnd shadow`, finds in the motions of an axis: its figures, and how they went lately. */

import { html } from "../html.js";
import { Panel, Table } from "../parts/controls.js";
import { number } from "../parts/format.js";

const [WIDTH, HEIGHT] = [160, 32];
const OLD_S = 60;
const DIGITS = 3;

export function ShadowPanel({ axis }) {
  const shadow = axis.samples.shadow;
  if (!shadow) return null;
  const old = axis.ageS("shadow") > OLD_S;
  const note = shadow.learning
    ? `It learns what is usual: ${shadow.judged} motions so far.`
    : "Means of the last motions beside what is usual. It says, and stops nothing.";
  const rows = shadow.figures.map(
    (each) => html`<tr><th scope="row">${each.figure}</th>
      <td class="number mark" data-level=${each.alarm ? "warn" : ""}>${number(each.value, DIGITS)}</td>
      <td class="number">${number(each.usual, DIGITS)}</td>
      <td>${allowed(each)} <span class="unit">${each.unit}</span></td>
      <td><${Trend} axis=${axis} figure=${each} /></td></tr>`,
  );
  return html`<${Panel} title="Shadow" of=${axis.rig} note=${note}>
    ${old && html`<p class="notice mark" data-level="warn">The observer has said nothing for a minute: these values are old.</p>`}
    ${rows.length > 0 &&
    html`<${Table} label=${`Shadow of ${axis.name}`} head=${["Figure", "#Now", "#Usual", "Allowed", "Trend"]} rows=${rows} />`}
    ${shadow.figures
      .filter(({ alarm }) => alarm)
      .map(({ figure, meaning }) => html`<p class="mark" data-level="warn">${figure}: ${meaning}</p>`)}
  <//>`;
}

/** Return the allowed range of a figure in words. */
export function allowed({ low, high }) {
  return low === null ? `up to ${number(high, DIGITS)}` : `${number(low, DIGITS)} to ${number(high, DIGITS)}`;
}

/** A small curve of a figure since the page is open, within its allowed range. */
function Trend({ axis, figure }) {
  const points = axis.shadows.map((each) => each.figures.find((one) => one.figure === figure.figure)?.value).filter(Number.isFinite);
  if (points.length < 2) return html`<span class="quiet">begins</span>`;
  const low = Math.min(figure.low ?? 0, ...points);
  const high = Math.max(figure.high, ...points);
  const y = (value) => HEIGHT - 2 - ((value - low) / (high - low || 1)) * (HEIGHT - 4);
  const line = points.map((value, at) => `${((at / (points.length - 1)) * WIDTH).toFixed(1)},${y(value).toFixed(1)}`).join(" ");
  return html`<svg viewBox=${`0 0 ${WIDTH} ${HEIGHT}`} width=${WIDTH} height=${HEIGHT} role="img"
    aria-label=${`${figure.figure}: from ${number(points[0], DIGITS)} to ${number(points.at(-1), DIGITS)}`}>
    <line x1="0" x2=${WIDTH} y1=${y(figure.high)} y2=${y(figure.high)} stroke="currentColor" stroke-dasharray="3 3" opacity="0.5" />
    <polyline points=${line} fill="none" stroke="currentColor" stroke-width="1.5" /></svg>`;
}
