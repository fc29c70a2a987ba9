/** Tuning: a test move with a trace, what it shows, and the gains that made it, side by side. */

import { html, useEffect, useId, useMemo, useRef, useState } from "../html.js";
import { ChartView } from "../parts/chart_view.js";
import { Action, Choice, Panel, Reason, Table, Tick } from "../parts/controls.js";
import { Curve } from "../parts/curve.js";
import { decimalsOf, duration, number, percent } from "../parts/format.js";
import { NumberField, unread } from "../parts/number_field.js";
import { unitsOf } from "../parts/number_text.js";
import { OneAxis } from "../parts/one_axis.js";
import { TraceProgress } from "../parts/trace_progress.js";
import { look } from "../session/channels.js";
import { obstacle } from "../session/obstacles.js";
import { MOVES, runs, runTest, wayOf } from "../session/test_moves.js";
import { AuthorityPanel } from "./axis_authority.js";
import { gainsOf, GainsTable, registersDoubt } from "./axis_gains.js";
import { hasGainParameters, ParameterBench } from "./tuning_parameters.js";

export function TuningPage({ at }) {
  const show = (axis) => (hasGainParameters(axis) ? html`<${ParameterBench} axis=${axis} />` : html`<${Bench} axis=${axis} />`);
  return html`<${OneAxis} at=${at} page="tuning" title="Tuning" can=${(axis) => axis.can("set_gains") || hasGainParameters(axis)}
    none="No axis with a position loop of its own is known yet." show=${show} />`;
}

function Bench({ axis }) {
  const [wanted, setWanted] = useState({});
  return html`<div class="bench">
    <div>
      <${TestMove} axis=${axis} />
      <${AuthorityPanel} axis=${axis} />
      <${Panel} title="Gains" of=${axis.rig} old=${registersDoubt(axis)} note="Nothing is written without a click.">
        <${GainsTable} axis=${axis} wanted=${wanted} onWanted=${setWanted} />
      <//>
    </div>
    <div class="bench-picture"><${Runs} axis=${axis} onPutBack=${setWanted} /></div>
  </div>`;
}

function TestMove({ axis }) {
  const [kind, setKind] = useState("trapezoid");
  const [distance, setDistance] = useState(1);
  const [settleS, setSettleS] = useState(0.5);
  const reason = useId();
  const isShown = useRef(true);
  useEffect(() => () => { isShown.current = false; }, []); // its page is left
  const way = wayOf(axis);
  const hindered =
    obstacle(axis, kind === "step" ? "track" : "move_relative") ??
    unread({ Distance: distance, "Record after it": settleS }) ??
    (distance > 0 ? null : "A distance above 0 is missing.");
  return html`<${Panel} title="Test move" note=${`It moves ${axis.name}, and the next one goes the other way.`}>
    <div class="fields">
      <${Choice} label="Shape" options=${Object.entries(MOVES).map(([key, { title }]) => [key, title])} value=${kind}
        onChange=${setKind} hint=${MOVES[kind].hint} />
      <${NumberField} label="Distance" units=${unitsOf(axis.info, "position")} value=${distance} onChange=${setDistance} min=${0} />
      <${NumberField} label="Record after it" unit="s" value=${settleS} onChange=${setSettleS} min=${0} max=${60} />
    </div>
    <p class="row"><${Action} kind="main" obstacle=${hindered} reason=${reason}
      act=${() => runTest(axis, { kind, distance: way * distance, settleS: settleS ?? 0 }, () => isShown.current)}
      >Move ${distance > 0 ? `${way * distance}`.replace("-", "−") : "–"} ${axis.info.unit} and record<//></p>
    ${hindered && html`<${Reason} id=${reason} text=${hindered} />`}
    <${TraceProgress} trace=${axis.trace} />
  <//>`;
}

function Runs({ axis, onPutBack }) {
  const all = runs(axis);
  const [hidden, setHidden] = useState(() => new Set());
  const shown = all.filter((run) => !hidden.has(run.number));
  const curves = useMemo(
    () => shown.flatMap((run, nth) => curvesOf(axis, run, nth)),
    [shown.map((run) => run.number).join()],
  );
  if (!all.length) {
    return html`<${Panel} title="Runs"><p class="quiet">No test move yet. Take control, enable the axis, then record one: it is drawn here.</p><//>`;
  }
  const hide = (run, on) =>
    setHidden(new Set(all.map((each) => each.number).filter((each) => (each === run.number ? !on : hidden.has(each)))));
  const decimals = decimalsOf(axis.info);
  const { unit } = axis.info;
  const names = Object.keys(gainsOf(axis));
  const rows = all.map(
    (run) => html`<tr key=${run.number}>
    <th scope="row"><${Tick} label=${`Run ${run.number}`} checked=${!hidden.has(run.number)}
      onChange=${(on) => hide(run, on)} /></th>
    <td>${MOVES[run.kind].title} ${number(run.distance, decimals)}</td>
    <td class="number">${number(run.result.overshoot, decimals)} <span class="quiet">${percent(run.result.overshootShare)}</span></td>
    <td class="number">${run.result.settlingS === null ? html`<span class="mark" data-level="warn">not settled</span>` : duration(run.result.settlingS)}</td>
    <td class="number">${duration(run.result.riseS)}</td>
    <td class="number">${number(run.result.peakError, decimals)}</td>
    <td class="number">${number(run.result.rmsError, decimals)}</td>
    <td class="number">${number(run.result.finalError, decimals)}</td>
    ${names.map((name) => html`<td class="number">${number(run.gains[name], 0)}</td>`)}
    <td><button type="button" class="plain"
      onClick=${() => onPutBack(run.gains)}>Put back<span class="unseen"> the gains of run ${run.number}</span></button></td>
  </tr>`,
  );
  const head = [
    "Run",
    "Move",
    "#Overshoot",
    "#Settling",
    "#Rise",
    "#Peak error",
    "#RMS error",
    "#Final error",
    ...names.map((name) => `#${name}`),
    "Gains",
  ];
  return html`<${Panel} title="Runs" note=${`Lengths in ${unit}. Settled is within ${number(all[0].band, decimals)} ${unit}, counted from the end of the profile.`}>
    <${ChartView} name=${`tuning ${axis.name}`} curves=${curves} height=${440} />
    <${Table} label="Runs and their gains" kind="runs" head=${head} rows=${rows} />
  <//>`;
}

/** Runs start at the same instant, whichever way they went, so that they lie over each other. */
function curvesOf(axis, run, nth) {
  const way = Math.sign(run.distance);
  const seconds = run.capture.seconds.map((each) => each - run.result.beganAtS);
  const flipped = (values, from) => values.map((value) => way * (value - from));
  const position = run.capture.channel("position").values;
  const error = run.capture.channel("following_error").values;
  const shown = {
    xs: seconds,
    dash: nth
      ? [
          [8, 4],
          [2, 3],
        ][(nth - 1) % 2]
      : [],
  };
  const { unit } = axis.info;
  const wanted = position.map((value, index) => value + error[index]);
  return [
    new Curve({
      ...shown,
      label: `${run.number} position`,
      unit,
      colour: look(2 * nth).colour,
      ys: flipped(position, run.start),
    }),
    ...(nth
      ? []
      : [
          new Curve({
            ...shown,
            label: `${run.number} commanded`,
            unit,
            colour: "--quiet",
            dash: [2, 3],
            ys: flipped(wanted, run.start),
          }),
        ]),
    new Curve({
      ...shown,
      label: `${run.number} following error`,
      unit,
      pane: `${unit} error`,
      colour: look(2 * nth + 1).colour,
      ys: flipped(error, 0),
    }),
  ];
}
