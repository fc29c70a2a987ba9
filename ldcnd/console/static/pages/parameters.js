/** The parameters of a drive that has readable ones: both memories, wear, dump, compare, restore. */

import { html, useEffect, useState } from "../html.js";
import { save } from "../parts/chart_view.js";
import { Action, Choice, Field, Panel, RefusalText, Table, Tick } from "../parts/controls.js";
import { Mark } from "../parts/state.js";
import { command } from "../session/control.js";
import { obstacle } from "../session/obstacles.js";
import { asToml, fromToml } from "../session/parameter_file.js";
import { useRigs } from "../session/rigs.js";
import { AuthorityPanel } from "./axis_authority.js";
import { AlarmPanel } from "./parameters_alarms.js";
import { AxisChoice } from "./trace.js";

/** All parameters of a slow drive on a bad line. */
const PATIENCE_MS = 65_000;
/** It holds the unit number: a restored one would make two drives answer at once. */
const UNIT_NUMBER = "Pn000";

export function ParametersPage({ at }) {
  const axes = [...useRigs().values()]
    .flatMap((rig) => [...rig.axes.values()])
    .filter((axis) => axis.can("list_parameters"));
  const axis = axes.find((each) => each.rig.name === at.rig && each.name === at.axis) ?? axes[0];
  if (!axis) {
    return html`<h1>Parameters</h1><p>No drive with readable parameters is known. LDCN and NMC drives have write-only
      registers: they stand on the page of each axis.</p>`;
  }
  return html`<h1>Parameters</h1>
    <${AxisChoice} axes=${axes} axis=${axis} page="parameters" />
    <${Memories} key=${`${axis.rig.name}/${axis.name}`} axis=${axis} />`;
}

function Memories({ axis }) {
  const [listed, setListed] = useState([]);
  const [values, setValues] = useState(null);
  const [file, setFile] = useState(null);
  const [only, setOnly] = useState({ text: "", differing: false });
  const [refusal, setRefusal] = useState(null);
  useEffect(() => {
    command(axis, "list_parameters").then((reply) => setListed(reply.parameters), setRefusal);
  }, [axis]);

  const renew = (value) => setValues(values.map((each) => (each.parameter === value.parameter ? value : each)));
  const readAll = async () => (await command(axis, "read_all_parameters", {}, PATIENCE_MS)).values;
  const rows = merged(listed, values, file).filter((row) => matches(row, only));

  return html`
    <${Panel} title=${`Memories of ${axis.name}`}
      note="RAM is in use and forgotten at power-off. EEPROM endures 10,000 writes.">
      <p class="row">
        <${Action} act=${readAll} onDone=${setValues} obstacle=${obstacle(axis, "parameters")}
          kind="main">${values ? "Read all again" : "Read all"}<//>
        <${Action} act=${() => save(new Blob([asToml(axis.name, values)], { type: "text/plain" }), `${axis.name}.toml`)}
          obstacle=${values ? null : "Read all first."}>Save to a file<//>
      </p>
      <${FilePicker} file=${file} onFile=${setFile} />
      <div class="fields">
        <${Field} label="Find" type="search" value=${only.text}
          onChange=${(text) => setOnly({ ...only, text: text ?? "" })} />
        <${Tick} label="Only what differs" checked=${only.differing}
          onChange=${(differing) => setOnly({ ...only, differing })} />
      </div>
      <${RefusalText} refusal=${refusal} />
      <${Table} label="Parameters" head=${["Number", "Name", "#RAM", "#EEPROM", "#File", "#Factory", "Range", "#EEPROM writes"]}
        rows=${rows.map((row) => html`<${Row} key=${row.parameter} row=${row} />`)} />
    <//>
    ${values && html`<${Change} axis=${axis} values=${values} listed=${listed} onWritten=${renew} />`}
    ${values && file && html`<${Restore} axis=${axis} values=${values} file=${file} onWritten=${renew} />`}
    <${AuthorityPanel} axis=${axis} />
    <${AlarmPanel} axis=${axis} />`;
}

function merged(listed, values, file) {
  const known = new Map(listed.map((info) => [info.parameter, info]));
  const read = new Map(values?.map((value) => [value.parameter, value]));
  return (values ?? listed).map(({ parameter }) => ({
    parameter,
    info: known.get(parameter),
    value: read.get(parameter),
    filed: file?.values.get(parameter),
    name: known.get(parameter)?.name ?? read.get(parameter)?.name,
  }));
}

function differs({ value, filed }) {
  return value !== undefined && (value.active !== value.stored || (filed !== undefined && filed !== value.active));
}

function matches(row, { text, differing }) {
  if (differing && !differs(row)) return false;
  return `${row.parameter} ${row.name}`.toLowerCase().includes(text.toLowerCase());
}

/** Settings that are read digit by digit are shown so. */
function shown(value, info) {
  if (value === undefined || value === null) return "–";
  return info?.digits ? `${value.toString(16).toUpperCase().padStart(4, "0")}H` : `${value}`;
}

function Row({ row }) {
  const { parameter, name, info, value, filed } = row;
  return html`<tr>
    <th scope="row">${parameter}</th><td>${name}${info?.power_cycle && html` <small>from the next power-on</small>`}</td>
    <td class="number">${shown(value?.active, info)}</td>
    <td class="number">${shown(value?.stored, info)}${value && value.active !== value.stored && html` <${Mark}
      level="warn">differs<//>`}</td>
    <td class="number">${shown(filed, info)}${filed !== undefined && value && filed !== value.active && html` <${Mark}
      level="warn">differs<//>`}</td>
    <td class="number quiet">${shown(info?.default, info)}</td>
    <td class="quiet">${info?.lowest == null ? "–" : `${shown(info.lowest, info)} to ${shown(info.highest, info)}`}${info?.unit ? ` ${info.unit}` : ""}${
      info?.confidence && info.confidence !== "S" ? " (not from the manual)" : ""
    }</td>
    <td class="number">${value?.eeprom_writes ?? "–"}</td>
  </tr>`;
}

function FilePicker({ file, onFile }) {
  const [problem, setProblem] = useState(null);
  async function pick(event) {
    const [picked] = event.target.files;
    if (!picked) return;
    try {
      onFile({ name: picked.name, values: fromToml(await picked.text()) });
      setProblem(null);
    } catch (error) {
      onFile(null);
      setProblem(error);
    }
  }
  return html`<div class="field"><label for="dump">Compare with a file</label>
    <input id="dump" type="file" accept=".toml,text/plain" onChange=${pick} />
    <small>${file ? `${file.values.size} values of ${file.name}` : "a dump of this page or of ldcnd params dump"}</small>
    <${RefusalText} refusal=${problem} /></div>`;
}

const MEMORIES = [
  ["ram", "RAM: in use at once, lost at power-off"],
  ["eeprom", "EEPROM: for good, wears it"],
];

function Change({ axis, values, listed, onWritten }) {
  const [set, setSet] = useState({ parameter: values[0].parameter, memory: "ram" });
  const info = listed.find((each) => each.parameter === set.parameter);
  const way =
    obstacle(axis, "write_parameter") ?? (set.value === null || set.value === undefined ? "A value is missing." : null);
  return html`<${Panel} title="Change one">
    <div class="fields">
      <${Choice} label="Parameter" options=${values.map((each) => [each.parameter, `${each.parameter} ${each.name}`])}
        value=${set.parameter} onChange=${(parameter) => setSet({ ...set, parameter })} />
      <${Field} label="New value" unit=${info?.unit ?? ""} value=${set.value} min="0" max="65535" step="1"
        onChange=${(value) => setSet({ ...set, value })}
        hint=${info?.digits ? `as a number; it is shown by digits: ${shown(set.value, info)}` : null} />
      <${Choice} label="Memory" options=${MEMORIES} value=${set.memory}
        onChange=${(memory) => setSet({ ...set, memory })} />
    </div>
    <p class="row"><${Action} act=${() => command(axis, "write_parameter", set)}
      onDone=${(reply) => onWritten(reply.value)} obstacle=${way}
      kind="main">Write ${set.parameter}<//></p>
  <//>`;
}

function Restore({ axis, values, file, onWritten }) {
  const [memory, setMemory] = useState("ram");
  const [told, setTold] = useState([]);
  const changes = values.filter(({ parameter, active, stored }) => {
    const wanted = file.values.get(parameter);
    return parameter !== UNIT_NUMBER && wanted !== undefined && wanted !== (memory === "ram" ? active : stored);
  });
  const way = obstacle(axis, "write_parameter") ?? (changes.length ? null : "Nothing differs.");
  async function restore() {
    const failed = [];
    for (const { parameter } of changes) {
      try {
        onWritten(
          (await command(axis, "write_parameter", { parameter, value: file.values.get(parameter), memory })).value,
        );
      } catch (error) {
        failed.push(`${parameter}: ${error.message}`);
      }
    }
    setTold([`${changes.length - failed.length} of ${changes.length} written.`, ...failed]);
  }
  return html`<${Panel} title="Restore from the file" note=${`${UNIT_NUMBER} is left out: it holds the unit number.`}>
    <${Choice} label="Memory" options=${MEMORIES} value=${memory} onChange=${setMemory} />
    <p>${changes.map(({ parameter }) => parameter).join(", ")}</p>
    <p class="row"><${Action} act=${restore} obstacle=${way}
      kind="main">Write ${changes.length === 1 ? "1 value" : `${changes.length} values`}<//></p>
    <div role="status">${told.map((each) => html`<p>${each}</p>`)}</div>
  <//>`;
}
