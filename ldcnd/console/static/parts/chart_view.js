/** A chart with what belongs to it: legend, two cursors that can be moved by keyboard, zoom, and the way out as files. */

import { html, useLayoutEffect, useRef, useState } from "../html.js";
import { Chart } from "./chart.js";
import { curvesAsCsv } from "./curve.js";
import { Table } from "./controls.js";
import { number } from "./format.js";
import { Mark } from "./state.js";

const ZOOM = 2;
const STEPS = 1000;
const DIGITS = 4;
const COUNTED_MS = 1_000;

/** Show `curves`; with `live` the span follows `live.now()` until the operator zooms.

 * `live` is `{now, windowS, paused, onPause}`. `name` is what exported files are called.
 */
export function ChartView({ curves, live = null, name, height, note }) {
  const root = useRef();
  const chart = useRef();
  const [cursors, setCursors] = useState({ a: null, b: null });
  const [zoom, setZoom] = useState(null);
  const [redraws, setRedraws] = useState(null);
  const looksBack = live ? live.paused || zoom !== null : true;

  useLayoutEffect(() => {
    chart.current = new Chart(root.current, { height });
    return () => chart.current.destroy();
  }, [height]);
  useLayoutEffect(() => {
    chart.current.show(curves);
    if (!live) setZoom(null);
  }, [curves]);

  // a chart outlives many renderings: it calls what the latest one says
  const act = useRef({});
  act.current = {
    zoomed: (span) => {
      live?.onPause(true);
      setZoom(span);
    },
    picked: (which, at) => setCursors((now) => ({ ...now, [which]: at })),
  };
  useLayoutEffect(() => {
    chart.current.onZoom = (span) => act.current.zoomed(span);
    chart.current.onPick = (which, at) => act.current.picked(which, at);
  }, []);

  // at once with the rendering: the span must not move on below cursors that are being placed
  useLayoutEffect(() => {
    const drawn = chart.current;
    drawn.cursors = cursors;
    if (looksBack) {
      drawn.span = zoom ?? (live ? drawn.span : drawn.extent());
      drawn.draw();
      return undefined;
    }
    let [count, sinceMs] = [drawn.drawn, performance.now()];
    let frame = requestAnimationFrame(function redraw(atMs) {
      const now = live.now();
      drawn.span = { min: now - live.windowS, max: now };
      drawn.draw();
      if (atMs - sinceMs >= COUNTED_MS) {
        setRedraws(Math.round(((drawn.drawn - count) * 1e3) / (atMs - sinceMs)));
        [count, sinceMs] = [drawn.drawn, atMs];
      }
      frame = requestAnimationFrame(redraw);
    });
    return () => cancelAnimationFrame(frame);
  }, [looksBack, zoom, cursors, curves, live?.windowS]);

  const span = () => zoom ?? chart.current?.span ?? { min: 0, max: 1 };
  function scale(factor) {
    const { min, max } = span();
    const [middle, half] = [(min + max) / 2, (max - min) / 2 / factor];
    act.current.zoomed({ min: middle - half, max: middle + half });
  }

  return html`<figure class="chart-view">
    <div class="chart" ref=${root} role="img"
      aria-label=${`${name}: ${curves.map((curve) => curve.label).join(", ") || "nothing yet"}. The values stand in the table below.`}></div>
    <p class="row tools">
      ${
        live &&
        html`<button type="button" aria-pressed=${live.paused ? "true" : "false"}
        onClick=${() => {
          setZoom(null);
          live.onPause(!live.paused);
        }}>${live.paused ? "Resume" : "Pause"}</button>`
      }
      <button type="button" onClick=${() => scale(ZOOM)}>Zoom in</button>
      <button type="button" onClick=${() => scale(1 / ZOOM)}>Zoom out</button>
      <button type="button" onClick=${() => setZoom(live && !live.paused ? null : chart.current.extent())}>Show all</button>
      <button type="button" onClick=${() => save(new Blob([curvesAsCsv(curves)], { type: "text/csv" }), `${name}.csv`)}>Save CSV</button>
      <button type="button" onClick=${async () => save(await chart.current.png(), `${name}.png`)}>Save PNG</button>
      ${live && !looksBack && redraws !== null && html`<span class="quiet number" data-redraws=${redraws}>${redraws} redraws a second</span>`}
      ${note}
    </p>
    <${Cursors} curves=${curves} cursors=${cursors} onCursors=${setCursors} span=${span} fixed=${looksBack} />
  </figure>`;
}

function Cursors({ curves, cursors, onCursors, span, fixed }) {
  const { min, max } = span();
  const { a, b } = cursors;
  const slider = (which, title) => html`<label class="slider"><span>${title}</span>
    <input type="range" min="0" max=${STEPS}
      value=${cursors[which] === null ? (which === "a" ? 0 : STEPS) : ((cursors[which] - min) / (max - min)) * STEPS}
      onInput=${({ target }) => onCursors({ ...cursors, [which]: min + (target.value / STEPS) * (max - min) })} />
    <output class="number">${cursors[which] === null ? "off" : `${number(cursors[which], DIGITS)} s`}</output></label>`;
  const at = (curve, x) => (x === null ? null : curve.valueAt(x));
  const rows = curves.map((curve) => {
    const [first, second] = [at(curve, a), at(curve, b)];
    return html`<tr key=${curve.label}>
      <th scope="row"><${Swatch} curve=${curve} />${curve.label}</th>
      <td class="number"><${Last} curve=${curve} /></td>
      <td class="number">${number(first, DIGITS)}</td><td class="number">${number(second, DIGITS)}</td>
      <td class="number">${first === null || second === null ? "–" : number(second - first, DIGITS)}</td>
      <td class="unit">${curve.unit || "0 or 1"}</td></tr>`;
  });
  return html`
    ${
      fixed
        ? html`<div class="row">${slider("a", "Cursor A")}${slider("b", "Cursor B")}
        <p class="number">${a !== null && b !== null ? `B − A: ${number(b - a, DIGITS)} s${a === b ? "" : `, ${number(1 / Math.abs(b - a), 2)} Hz`}` : "Click the chart for A, with Shift for B."}</p></div>`
        : html`<p class="quiet">Pause to place the cursors. Drag over the chart to look closer.</p>`
    }
    <${Table} label="Values of the curves" head=${["Curve", "#Last", "#At A", "#At B", "#B − A", "Unit"]}
      rows=${rows} />`;
}

/** The last value of a curve: in brackets and with its mark where it is not to be believed any more. */
function Last({ curve }) {
  const mark = curve.mark?.();
  let at = curve.length - 1;
  while (mark && at > 0 && !Number.isFinite(curve.ys[at])) at -= 1; // a gap, behind the value that was good
  const value = number(at < 0 ? null : curve.ys[at], DIGITS);
  return mark ? html`<span class="place" data-known="no"><b>(${value})</b> <${Mark} level="bad">${mark}<//></span>` : value;
}

/** A piece of the curve's line: its colour and its dashes. */
export function Swatch({ curve }) {
  return html`<svg class="swatch" viewBox="0 0 28 8" aria-hidden="true"><line x1="0" y1="4" x2="28" y2="4"
    stroke=${`var(${curve.colour})`} stroke-width="2.5" stroke-dasharray=${curve.dash.join(" ")} /></svg>`;
}

/** Let the browser save a file. */
export function save(blob, name) {
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}
