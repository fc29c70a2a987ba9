/** What one packet does to a whole line: a snapshot of all positions and inputs; and its PIC-I/O modules. */

import { html, useState } from "../html.js";
import { Action, Choice, Facts, Panel, Table } from "../parts/controls.js";
import { number } from "../parts/format.js";
import { levelsOf, readingOf } from "../parts/module_reading.js";
import { NumberField, unread } from "../parts/number_field.js";
import { ofRig, stopsOf } from "../session/control.js";

const BECOMES = [
  ["high", "output, high"],
  ["low", "output, low"],
  ["inputs", "input"],
];
const TIMER = [
  ["off", "nothing"],
  ["timer", "time, at 5 MHz"],
  ["counter", "edges of line 10"],
];

export function Snapshot({ rig, bus }) {
  const [taken, setTaken] = useState(null);
  const rows = taken && [
    ...taken.positions.map(
      (each) => html`<tr><th scope="row">${each.axis}</th>
      <td class="number">${number(each.position, 4)} ${each.unit}</td><td class="number">${each.counts}</td>
      <td>${each.referenced ? "" : "not referenced"}</td></tr>`,
    ),
    ...taken.io.map(
      (each) => html`<tr><th scope="row">${each.module}</th><td>${levelsOf(each.levels)}</td>
      <td class="number">${each.counter}</td><td>${each.proven ? "" : "not proven: nothing is counted"}</td></tr>`,
    ),
  ];
  return html`<h3>One instant</h3>
    <p class="row"><${Action} act=${() => ofRig(rig, "snapshot", { bus })} onDone=${setTaken}>Take a snapshot of ${rig.name} on ${bus}<//></p>
    ${taken && html`<${Table} label=${`Snapshot of ${rig.name} on ${bus}`} head=${["Of", "Value", "#Counts", "Remark"]} rows=${rows} />
    <p class="quiet">All within ${number(taken.t_error_ns / 1e6, 2)} ms.</p>`}`;
}

/** A panel for each module that has a name. */
export function Modules({ rig, bus }) {
  const named = bus.info.modules.filter((module) => module.name);
  return named.map((module) => html`<${Module} key=${module.name} rig=${rig} name=${module.name} outputs=${module.outputs} />`);
}

function Module({ rig, name, outputs }) {
  const [chosen, setLine] = useState(null);
  const line = chosen ?? outputs[0];
  const [becomes, setBecomes] = useState("high");
  const [pwm, setPwm] = useState({});
  const [counts, setCounts] = useState("off");
  const { named, all } = readingOf(rig, name);
  const troubles = rig.worth ? [] : rig.axis(name).condition.troubles;
  const told = (verb, body) => ofRig(rig, verb, { module: name, ...body });
  const set = async (body) => told("set_io", { ...body, after_stops: await stopsOf([...rig.axes.values()]) });
  return html`<${Panel} title=${`Module ${name}`} note="An output may move something; it keeps its level when this page is gone.">
    ${troubles.map(({ level, text }) => html`<p class="notice mark" data-level=${level}>${text}</p>`)}
    <${Facts} of=${[...named, ...all]} />
    <div class="fields">
      ${line && html`<${Choice} label="Line" options=${outputs.map((each) => [each, each])} value=${line} onChange=${setLine} />
      <${Choice} label="Becomes" options=${BECOMES} value=${becomes} onChange=${setBecomes} />`}
      <${NumberField} label="PWM 1" value=${pwm.pwm1} min=${0} max=${1} onChange=${(pwm1) => setPwm((last) => ({ ...last, pwm1 }))} hint="0 to 1; empty: as it is" />
      <${NumberField} label="PWM 2" value=${pwm.pwm2} min=${0} max=${1} onChange=${(pwm2) => setPwm((last) => ({ ...last, pwm2 }))} hint="0 to 1; empty: as it is" />
      <${Choice} label="Counts" options=${TIMER} value=${counts} onChange=${setCounts} />
    </div>
    ${!line && html`<p class="quiet">None of its lines is configured as an output.</p>`}
    <p class="row">
      <${Action} act=${() => told("set_io")}>Read ${name}<//>
      ${line && html`<${Action} kind="main" act=${() => set({ [becomes]: [Number(line) || line] })}>Set line ${line}<//>`}
      <${Action} act=${() => set(pwm)} obstacle=${unread({ "PWM 1": pwm.pwm1, "PWM 2": pwm.pwm2 })}>Set PWM<//>
      <${Action} act=${() => told("set_io_timer", { mode: counts })}>Count<//>
    </p>
  <//>`;
}
