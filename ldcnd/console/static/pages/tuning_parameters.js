/** Tuning a drive whose gains are parameters: change one in RAM, record while the machine moves, compare the runs. */

import { html, useEffect, useState } from "../html.js";
import { Action, Panel, RefusalText, Table } from "../parts/controls.js";
import { clock, number } from "../parts/format.js";
import { NumberField, unread } from "../parts/number_field.js";
import { TraceProgress } from "../parts/trace_progress.js";
import { arm } from "../session/captures.js";
import { client, command } from "../session/control.js";
import { obstacle } from "../session/obstacles.js";
import { AuthorityPanel } from "./axis_authority.js";

const GAINS = ["Pn100", "Pn101", "Pn102", "Pn103", "Pn109", "Pn10A", "Pn401"];
const CHANNELS = ["speed_feedback", "position_deviation", "inp"];
const POINTS = 500;
const PATIENCE_MS = 65_000;
const MOST_RUNS = 8;

export const hasGainParameters = (axis) => axis.can("write_parameter") && axis.can("trace") && !axis.can("set_gains");

export function ParameterBench({ axis }) {
  const [gains, setGains] = useState([]);
  const [runs, setRuns] = useState([]);
  const [refusal, setRefusal] = useState(null);
  const [readAt, setReadAt] = useState(null);
  const read = async () => {
    const [values, at] = [[], axis.now()];
    for (const parameter of GAINS) values.push((await command(axis, "read_parameter", { parameter }, PATIENCE_MS)).value);
    setGains(values);
    setReadAt(at);
    setRefusal(null);
  };
  useEffect(() => {
    read().catch(setRefusal);
  }, [axis]);
  const renew = (value) => setGains((last) => last.map((each) => (each.parameter === value.parameter ? value : each)));
  const keep = (run) => setRuns((last) => [{ ...run, number: (last[0]?.number ?? 0) + 1 }, ...last].slice(0, MOST_RUNS));
  return html`<${AuthorityPanel} axis=${axis} />
    <${Panel} title="Gains" of=${axis.rig} old=${readAt && axis.doubt(readAt, client)} note="Written to RAM: in use at once, lost at power-off. Save them on the parameters page.">
      <${RefusalText} refusal=${refusal} />
      <p class="row"><${Action} act=${read} obstacle=${obstacle(axis, "parameters")}>${readAt ? "Read again" : "Read"}<//>
        ${readAt && html`<span class="quiet">Read at ${clock(axis.rig.nsAt(readAt.atMs)).slice(0, -4)}.</span>`}</p>
      ${gains.map((value) => html`<${Gain} key=${value.parameter} axis=${axis} value=${value} onWritten=${renew} />`)}
    <//>
    <${Record} axis=${axis} gains=${gains} onRun=${keep} />
    <${RunTable} runs=${runs} />`;
}

function Gain({ axis, value, onWritten }) {
  const [wanted, setWanted] = useState(undefined); // until something is typed, the field has what is in use
  const way = obstacle(axis, "write_parameter") ?? unread({ Value: wanted }) ?? (wanted == null ? "Type another value first." : null);
  return html`<div class="fields">
    <${NumberField} label=${`${value.parameter} ${value.name}`} value=${wanted === undefined ? value.active : wanted} whole min=${0} max=${65535}
      onChange=${setWanted} hint=${value.active === value.stored ? null : `${value.stored} is stored`} />
    <p class="row"><${Action} obstacle=${way} onDone=${(reply) => (onWritten(reply.value), setWanted(undefined))}
      act=${() => command(axis, "write_parameter", { parameter: value.parameter, value: wanted, memory: "ram" }, PATIENCE_MS)}
      >Write<//></p>
  </div>`;
}

function Record({ axis, gains, onRun }) {
  const [seconds, setSeconds] = useState(2);
  const record = async () => {
    const request = { channels: CHANNELS, interval_s: (seconds ?? 2) / POINTS, samples: POINTS, pre_trigger: 0 };
    const { finished } = await arm(axis, request);
    const capture = await finished;
    return { gains: gains.map(({ parameter, active }) => [parameter, active]), ...judged(capture) };
  };
  return html`<${Panel} title="Record" note="The pulses that move this drive come from elsewhere: let the machine move, then record.">
    <div class="fields"><${NumberField} label="Duration" unit="s" value=${seconds} onChange=${setSeconds} min=${1} max=${60} /></div>
    <p class="row"><${Action} kind="main" act=${record} onDone=${onRun} obstacle=${obstacle(axis, "trace") ?? unread({ Duration: seconds })}>Record<//></p>
    <${TraceProgress} trace=${axis.trace} />
  <//>`;
}

function judged(capture) {
  const deviation = capture.channel("position_deviation").values;
  const speed = capture.channel("speed_feedback").values;
  const inPosition = capture.channel("inp").values;
  const square = deviation.reduce((sum, value) => sum + value * value, 0);
  return {
    largest: deviation.reduce((most, value) => Math.max(most, Math.abs(value)), 0),
    typical: Math.sqrt(square / deviation.length),
    speed: speed.reduce((most, value) => Math.max(most, Math.abs(value)), 0),
    inPosition: inPosition.filter((value) => value).length / inPosition.length,
  };
}

function RunTable({ runs }) {
  if (!runs.length) return null;
  const head = ["Run", "#Largest deviation", "#Typical deviation", "#Top speed (r/min)", "#INP high", "Gains"];
  return html`<${Panel} title="Runs" note="Deviations in command units.">
    <${Table} label="Runs" head=${head} rows=${runs.map(
      (run) => html`<tr><th scope="row">${run.number}</th><td class="number">${number(run.largest, 0)}</td>
      <td class="number">${number(run.typical, 1)}</td><td class="number">${number(run.speed, 0)}</td>
      <td class="number">${number(run.inPosition * 100, 0)} %</td>
      <td><small>${run.gains.map(([name, value]) => `${name} ${value}`).join(", ")}</small></td></tr>`,
    )} /><//>`;
}
