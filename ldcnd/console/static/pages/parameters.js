/** The parameters of a drive that has readable ones: both memories, wear, digits, compare, restore, save, clone. */

import { html, useEffect, useState } from "../html.js";
import { save } from "../parts/chart_view.js";
import { Action, Choice, Panel, RefusalText, Table, Tick } from "../parts/controls.js";
import { clock } from "../parts/format.js";
import { NumberField, TextField, unread } from "../parts/number_field.js";
import { OneAxis } from "../parts/one_axis.js";
import { Mark } from "../parts/state.js";
import { client, command } from "../session/control.js";
import { obstacle } from "../session/obstacles.js";
import { asToml, driverTypeOf, fromToml } from "../session/parameter_file.js";
import { axesOf } from "../session/rigs.js";
import { AuthorityPanel } from "./axis_authority.js";
import { AlarmPanel } from "./parameters_alarms.js";

/** All parameters of a slow drive on a bad line. */
const PATIENCE_MS = 65_000;
const LARGEST = 0xffff;

export function ParametersPage({ at }) {
  return html`<${OneAxis} at=${at} page="parameters" title="Parameters" can=${(axis) => axis.can("list_parameters")}
    none="No drive with readable parameters is known. LDCN and NMC drives have write-only registers: they are on each axis's page."
    show=${(axis) => html`<${Memories} axis=${axis} />`} />`;
}

function Memories({ axis }) {
  const [listed, setListed] = useState([]);
  const [dump, setDump] = useState(null);
  const values = dump?.values ?? null;
  const [file, setFile] = useState(null);
  const [only, setOnly] = useState({ text: "", differing: false });
  const [refusal, setRefusal] = useState(null);
  useEffect(() => {
    command(axis, "list_parameters").then((reply) => setListed(reply.parameters), setRefusal);
  }, [axis]);

  const renew = (value) =>
    setDump((last) => ({
      ...last,
      values: last.values.map((each) => (each.parameter === value.parameter ? value : each)),
    }));
  const recount = (total) =>
    setDump((last) => ({
      ...last,
      values: last.values.map((each) => ({ ...each, eeprom_total: total, eeprom_writes: 0 })),
    }));
  const readAll = async () => {
    const read = axis.now();
    return { ...(await allOf(axis)), read };
  };
  const doubt = dump && axis.doubt(dump.read, client);
  const rows = merged(listed, values, file).filter((row) => matches(row, only));

  return html`
    <${Panel} title=${`Memories of ${axis.name}`} of=${axis.rig} old=${doubt && `${doubt} Read all again.`}
      note="RAM is in use and forgotten at power-off. EEPROM endures 10,000 writes.">
      <p class="row">
        <${Action} act=${readAll} onDone=${setDump} obstacle=${obstacle(axis, "parameters")}
          kind="main">${values ? "Read all again" : "Read all"}<//>
        <${Action} act=${() => save(new Blob([asToml(axis.name, dump)], { type: "text/plain" }), `${axis.name}.toml`)}
          obstacle=${values ? null : "Read all first."}>Save to a file<//>
        ${dump && html`<span class="quiet">Read at ${clock(axis.rig.nsAt(dump.read.atMs)).slice(0, -4)}.</span>`}
      </p>
      <${FilePicker} file=${file} onFile=${setFile} />
      <div class="fields">
        <${TextField} label="Find" type="search" value=${only.text || null}
          onChange=${(text) => setOnly({ ...only, text: text ?? "" })} />
        <${Tick} label="Only what differs" checked=${only.differing}
          onChange=${(differing) => setOnly({ ...only, differing })} />
      </div>
      <${RefusalText} refusal=${refusal} />
      <${Table} label="Parameters" head=${["Number", "Name", "#RAM", "#EEPROM", "#File", "#Factory (a hint)", "Range", "#EEPROM writes"]}
        rows=${rows.map((row) => html`<${Row} key=${row.parameter} row=${row} />`)} />
    <//>
    ${values && html`<${Change} axis=${axis} read=${dump.read} values=${values} listed=${listed} onRead=${renew} />`}
    ${values && html`<${Wear} axis=${axis} values=${values} onCounted=${recount} />`}
    ${values && html`<${Transfer} key=${file?.pick} axis=${axis} file=${file} onWritten=${renew} />`}
    <${AuthorityPanel} axis=${axis} />
    <${AlarmPanel} axis=${axis} />`;
}

/** Read every parameter of a drive. */
function allOf(axis) {
  return command(axis, "read_all_parameters", {}, PATIENCE_MS);
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
  return info?.digits ? hex(value) : `${value}`;
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

/** How many files were picked: one of the same name may hold other values. */
let picks = 0;

function FilePicker({ file, onFile }) {
  const [problem, setProblem] = useState(null);
  async function pick(event) {
    const [picked] = event.target.files;
    if (!picked) return;
    event.target.value = ""; // else the same file, picked again, would be no change and not be read
    const number = (picks += 1);
    try {
      const text = await picked.text();
      if (number !== picks) return; // another one was picked meanwhile
      onFile({ pick: number, name: picked.name, values: fromToml(text), driverType: driverTypeOf(text) });
      setProblem(null);
    } catch (error) {
      if (number !== picks) return;
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

/** A whole word is typed, or digits are chosen: the other digits are written as they were read, if that still holds. */
function Change({ axis, read, values, listed, onRead }) {
  const [set, setSet] = useState({ parameter: values[0].parameter, memory: "ram", digits: {} });
  const [remarks, setRemarks] = useState([]);
  const { parameter, memory, confirm_unit } = set;
  const info = listed.find((each) => each.parameter === parameter);
  const held = values.find((each) => each.parameter === parameter);
  const present = memory === "ram" ? held.active : held.stored;
  const chosen = Object.entries(set.digits);
  const text = set.text ?? (chosen.length ? hex(chosen.reduce(withDigit, present)) : undefined);
  const word = text === undefined ? undefined : wordOf(text);
  const noWord = set.text && word === undefined ? `“${set.text}” is not 0 to 65535, without zeros in front, nor 0x0000 to 0xFFFF` : null;
  const doubt = chosen.length ? axis.doubt(held.read ?? read, client) : null;
  const way =
    obstacle(axis, "write_parameter") ??
    unread({ "New unit number": confirm_unit }) ??
    (noWord ? `New value: ${noWord}.` : word === undefined ? "A value from 0 to 65535 is missing." : null) ??
    (doubt && `Read ${parameter} again: ${doubt}`);
  const since = async (verb, body) => {
    const read = axis.now();
    const { value, remarks } = await command(axis, verb, body, PATIENCE_MS);
    return { value: { ...value, read }, remarks: remarks ?? [] };
  };
  const write = () => since("write_parameter", { parameter, memory, confirm_unit, value: word });
  const readOne = () => since("read_parameter", { parameter });
  const renewed = ({ value, remarks }) => (onRead(value), setRemarks(remarks));
  const select = (next) => setSet({ parameter: next, memory, digits: {} });
  const type = (typed) => setSet((last) => ({ ...last, text: typed ?? undefined, digits: {} }));
  const choose = (...digit) =>
    setSet(
      set.text !== undefined && word !== undefined
        ? { ...set, text: hex(withDigit(word, digit)) }
        : { ...set, text: undefined, digits: { ...set.digits, [digit[0]]: digit[1] } },
    );
  return html`<${Panel} title="Change one">
    <div class="fields">
      <${Choice} label="Parameter" options=${values.map((each) => [each.parameter, `${each.parameter} ${each.name}`])}
        value=${parameter} onChange=${select} />
      <${TextField} label=${html`New value${info?.unit && html` <span class="unit">${info.unit}</span>`}`} value=${text ?? null}
        onChange=${type}
        hint=${word === undefined ? noWord ? html`<span class="unread">${noWord}</span>` : "decimal, or hexadecimal as 0x0101 or 0101H" : `${word} is ${hex(word)}`} invalid=${set.text !== undefined && word === undefined} />
      <${Choice} label="Memory" options=${MEMORIES} value=${memory}
        onChange=${(memory) => setSet({ ...set, memory })} />
      ${
        parameter === "Pn000" &&
        html`<${NumberField} label="New unit number, if it changes" value=${confirm_unit} whole min=${0} max=${15}
        onChange=${(unit) => setSet((last) => ({ ...last, confirm_unit: unit ?? null }))} />`
      }
    </div>
    ${info?.digits && html`<${Digits} info=${info} word=${word ?? present} onDigit=${choose} />`}
    <p class="row"><${Action} act=${write} onDone=${renewed} obstacle=${way} kind="main">Write ${parameter}<//>
      ${info?.digits && html`<${Action} act=${readOne} onDone=${renewed} obstacle=${obstacle(axis, "parameters")}>Read ${parameter} again<//>`}</p>
    <div role="status">${remarks.map((each) => html`<p>${each}</p>`)}</div>
  <//>`;
}

/** Return the word that a text stands for, decimal or hexadecimal; undefined for none. */
export function wordOf(text) {
  const written = text.trim();
  const digits = /^(?:0x([0-9a-f]{1,4})|([0-9a-f]{1,4})h)$/i.exec(written);
  const isDecimal = /^(?:0{0,3}\d|[1-9]\d{0,4})$/.test(written); // with zeros in front it could be the digits
  const word = digits ? Number.parseInt(digits[1] ?? digits[2], 16) : isDecimal ? Number(written) : Number.NaN;
  return word <= LARGEST ? word : undefined;
}

/** The four digits of a parameter, each with what its values mean as far as that is known; .0 is the rightmost. */
function Digits({ info, word, onDigit }) {
  const known = new Map(info.digit_meanings.map((digit) => [digit.digit, digit]));
  return html`<div class="fields" role="group" aria-label="Digits">${[3, 2, 1, 0].map((place) => {
    const digit = known.get(place);
    const options = [...Array(16).keys()].map((value) => {
      const own = value.toString(16).toUpperCase();
      return [own, digit?.values[own] ? `${own}: ${digit.values[own]}` : own];
    });
    const own = ((word >> (4 * place)) & 0xf).toString(16).toUpperCase();
    return html`<${Choice} label=${`${info.parameter}.${place}`} options=${options} value=${own}
      hint=${digit ? `${digit.title} [${digit.confidence}]` : "not described"} onChange=${(value) => onDigit(place, value)} />`;
  })}</div>`;
}

/** Return a word with another digit in a place. */
function withDigit(word, [place, digit]) {
  return (word & ~(0xf << (4 * place))) | (Number.parseInt(digit, 16) << (4 * place));
}

/** Writes are counted for a drive; another drive in its place has taken none of them. */
function Wear({ axis, values, onCounted }) {
  const [replaced, setReplaced] = useState(false);
  const total = values[0]?.eeprom_total;
  if (total == null) return null;
  const way = obstacle(axis, "write_parameter") ?? (replaced ? null : "Only for a drive that was replaced.");
  return html`<${Panel} title="EEPROM writes" note="All parameters together; the memory endures 10,000.">
    <p>${total} writes counted for this drive.</p>
    <${Tick} label="The drive was replaced by a new one" checked=${replaced} onChange=${setReplaced} />
    <p class="row"><${Action} act=${() => command(axis, "restart_eeprom_count")} obstacle=${way}
      onDone=${({ total }) => (setReplaced(false), onCounted(total))}>Count anew<//></p>
  <//>`;
}

/** Where values can come from: a file, another drive, or what this drive has in use; drives are read when it is asked. */
function sourcesOf(axis, file) {
  const others = axesOf().filter((each) => each !== axis && each.can("list_parameters"));
  return [
    file && {
      title: `the file ${file.name}`,
      ask: async () => ({ values: Object.fromEntries(file.values), driver_type: file.driverType }),
    },
    {
      title: `what ${axis.name} has in use, for good`,
      ask: async () => {
        const { values } = await allOf(axis);
        return { values: words(values.filter(differing), "active"), any_type: true, memory: "eeprom" };
      },
    },
    ...others.map((other) => ({
      title: `the drive ${other.rig.name} · ${other.name}`,
      ask: async () => {
        const dump = await allOf(other);
        return { values: words(dump.values, "stored"), driver_type: dump.facts.driver_type };
      },
    })),
  ].filter(Boolean);
}

function differing({ active, stored }) {
  return active !== stored;
}

function words(values, memory) {
  return Object.fromEntries(values.map((value) => [value.parameter, value[memory]]));
}

/** The daemon plans; this page shows the plan, sends its writes one by one, and plans again to prove them. */
function Transfer({ axis, file, onWritten }) {
  const sources = sourcesOf(axis, file);
  const [chosen, setChosen] = useState(sources[0].title);
  const [wanted, setWanted] = useState(null);
  const [plan, setPlan] = useState(null);
  const [report, setReport] = useState([]);
  const source = sources.find((each) => each.title === chosen); // one that has gone is not replaced
  const planned = async (request) => (await command(axis, "plan_parameters", request, PATIENCE_MS)).plan;
  const ask = async () => {
    const read = axis.now();
    const request = await source.ask();
    return { request, plan: await planned(request), read };
  };
  const outdated = plan && axis.doubt(plan.read, client);
  const way =
    obstacle(axis, "write_parameter") ??
    (outdated && `Plan it again: ${outdated}`) ??
    (!plan ? "Plan it first." : plan.problems.length ? plan.problems[0] : plan.writes.length ? null : "Nothing differs.");
  async function transfer() {
    const lines = [];
    for (const [place, { parameter, value, memory }] of plan.writes.entries()) {
      setReport([`${place + 1} of ${plan.writes.length}: ${parameter} to ${memory}`]);
      try {
        const reply = await command(axis, "write_parameter", { parameter, value, memory }, PATIENCE_MS);
        onWritten(reply.value);
        lines.push(...reply.remarks);
      } catch (error) {
        lines.push(`${parameter} failed: ${error.message}. ${plan.writes.length - place - 1} not tried.`);
        break;
      }
    }
    const read = axis.now();
    const left = await planned(wanted);
    setPlan({ ...left, read });
    setReport([
      left.writes.length
        ? "Read back: not all is written. The same again completes it."
        : "Read back: the drive holds the values.",
      ...new Set(lines),
    ]);
  }
  return html`<${Panel} title="Restore, save or clone" note="The unit number in Pn000 stays as it is in the drive.">
    <${Choice} label="Values of" options=${sources.map(({ title }) => [title, title])} value=${chosen} missing=${chosen}
      onChange=${(title) => (setChosen(title), setPlan(null))} />
    <p class="row"><${Action} act=${ask} obstacle=${source ? obstacle(axis, "parameters") : "These values are not there any more."}
      onDone=${({ request, plan, read }) => (setWanted(request), setPlan({ ...plan, read }))}>Plan<//></p>
    ${plan?.problems.map((each) => html`<p><${Mark} level="bad">cannot be done<//> ${each}</p>`)}
    ${
      plan?.writes.length > 0 &&
      html`<${Table} label="Writes" head=${["Parameter", "Memory", "#Now", "#New", "Takes effect"]}
      rows=${plan.writes.map(
        (write) => html`<tr><th scope="row">${write.parameter} ${write.name}</th><td>${write.memory}</td>
        <td class="number">${write.before} (${hex(write.before)})</td>
        <td class="number">${write.value} (${hex(write.value)})</td>
        <td>${write.effective}${write.digits.map((digit) => html`<br /><small>${digit}</small>`)}</td></tr>`,
      )} />`
    }
    ${plan?.remarks.map((each) => html`<p class="quiet">${each}</p>`)}
    <p class="row"><${Action} act=${transfer} obstacle=${way}
      kind="main">Write ${plan?.writes.length === 1 ? "1 value" : `${plan?.writes.length ?? 0} values`}<//></p>
    <div role="status">${report.map((each) => html`<p>${each}</p>`)}</div>
  <//>`;
}

function hex(value) {
  return `${value.toString(16).toUpperCase().padStart(4, "0")}H`;
}
