/** The rig page: faults and warnings first, then every axis of every line of every rig, and what can be asked of them. */

import { html, useId, useState } from "../html.js";
import { Action, Facts, Tick } from "../parts/controls.js";
import { dateAndClock, decimalsOf, duration, number, percent, words } from "../parts/format.js";
import { problems } from "../parts/problems.js";
import { FaultWords, Mark, Meter, Place, QualityWord, StateWord } from "../parts/state.js";
import { ask } from "../session/api.js";
import { command, controls, release, take } from "../session/control.js";
import { obstacle } from "../session/obstacles.js";
import { endpoints, useRigs } from "../session/rigs.js";
import { GroupMoves } from "./rig_groups.js";
import { SpeedOverride } from "./rig_speed.js";

const COLUMNS = ["Axis", "State", "Position", "Velocity", "Target", "A/D", "Faults", "Values", "Control", "Commands"];
const FULL = 0.9;
const COUNTERS = [
  ["timeouts", "timeouts"],
  ["corrupt_replies", "corrupt"],
  ["rejected_packets", "rejected"],
  ["resent", "retries"],
  ["resynchronisations", "resyncs"],
  ["losses", "port losses"],
];

export function RigPage() {
  const all = [...useRigs().values()];
  return html`
    <h1 class="unseen">Rig</h1>
    <${Attention} rigs=${all} />
    ${all.length ? all.map((rig) => html`<${RigSection} key=${rig.name} rig=${rig} />`) : html`<${NoRig} />`}
    <${Invitation} />`;
}

/** A link that lets one more browser in. */
function Invitation() {
  const [link, setLink] = useState(null);
  return html`<footer class="row">
    <${Action} act=${() => ask("/api/link")} onDone=${(reply) => setLink(reply.link)}>Let another browser in<//>
    ${link && html`<p role="status"><code>${link}</code> <small>opens the console once, within ten minutes</small></p>`}
  </footer>`;
}

function NoRig() {
  return html`<section class="panel"><h2>No rig yet</h2>
    <p>No daemon has been heard. Start one, <code>ldcnd run --config config/simulated.toml</code>, or name its endpoint
      to <code>ldcnd console -e</code>. This page shows it as soon as it is there.</p>
    <ul>${endpoints.map(({ endpoint, connected, problem }) => html`<li>${endpoint}: ${problem ?? (connected ? "connected" : "not connected")}</li>`)}</ul>
  </section>`;
}

function Attention({ rigs }) {
  const wrong = problems(rigs);
  if (!wrong.length) return null;
  return html`<section class="attention" aria-labelledby="attention">
    <h2 id="attention">Needs attention</h2>
    <ul>${wrong.map(
      ({ level, text, places }) => html`<li key=${`${level} ${text}`} data-level=${level}>
      <${Mark} level=${level}>${level === "bad" ? "fault" : "warning"}<//>
      <span>${text}</span> <span class="places">${places.map(({ where, link, detail }) => html`<a
        href=${link}>${where}</a>${detail && html` <span class="quiet number">${detail}</span>`} `)}</span>
    </li>`,
    )}</ul>
  </section>`;
}

function RigSection({ rig }) {
  return html`<section class="rig" aria-label=${`Rig ${rig.name}`} data-stale=${rig.worth ? "yes" : "no"}>
    <header>
      <h2>${rig.name}</h2>
      <${Facts} of=${[
        ["daemon", rig.daemon && `ldcnd ${rig.daemon.version}`],
        ["since", rig.daemon && dateAndClock(rig.daemon.started).slice(0, -4)],
        ["at", rig.endpoint],
        ["loop lag", duration(rig.health?.loop_lag_s)],
      ]} />
    </header>
    ${rig.worth && html`<p class="notice mark" data-level="bad">${rig.worth.why} The values below are the last known ones.</p>`}
    <${RigCommands} rig=${rig} />
    <${SpeedOverride} rig=${rig} />
    <${GroupMoves} rig=${rig} />
    ${[...rig.buses.values()].map((bus) => html`<${BusSection} key=${bus.name} rig=${rig} bus=${bus} />`)}
  </section>`;
}

function BusSection({ rig, bus }) {
  const axes = [...rig.axes.values()].filter((axis) => axis.info?.bus === bus.name);
  return html`<section class="bus" aria-label=${`Line ${bus.name} of ${rig.name}`}>
    <${BusLine} rig=${rig} bus=${bus} />
    <table class="axes" role="table" aria-label=${`Axes of ${rig.name} on ${bus.name}`}>
      <thead role="rowgroup"><tr role="row">${COLUMNS.map((each) => html`<th role="columnheader" scope="col">${each}</th>`)}</tr></thead>
      <tbody role="rowgroup">${axes.map((axis) => html`<${AxisRow} key=${axis.name} axis=${axis} />`)}</tbody>
    </table>
  </section>`;
}

function BusLine({ rig, bus }) {
  const { info, health } = bus;
  const up = rig.worth ? null : bus.up;
  return html`<header class="bus-line">
    <h3>${bus.name}</h3>
    <${Mark} level=${up === false ? "bad" : ""}>${up === null ? "unknown" : up ? "up" : "down"}<//>
    <span class="quiet">${info?.port}, ${info?.baud} baud</span>
    ${up && html`<${Meter} label="in use" share=${health?.utilisation} text=${percent(health?.utilisation)}
      level=${health?.utilisation > FULL ? "warn" : ""} />`}
    <ul class="counters" aria-label="Link quality">
      ${COUNTERS.map(([counter, label]) => html`<${Counter} bus=${bus} counter=${counter} label=${label} />`)}
    </ul>
  </header>`;
}

function Counter({ bus, counter, label }) {
  const lately = bus.lately(counter);
  return html`<li><span class="quiet">${label}</span> <b>${bus.health?.[counter] ?? "–"}</b>
    ${lately > 0 && html` <${Mark} level="warn">+${lately} in the last minute<//>`}</li>`;
}

function AxisRow({ axis }) {
  const { info, samples, state, health } = axis;
  const decimals = decimalsOf(info);
  const { adc } = samples;
  const { live } = axis.condition;
  const cell = (label, content, kind = "") => html`<td role="cell" data-label=${label} class=${kind}>${content}</td>`;
  return html`<tr role="row" data-axis=${axis.name} data-stale=${live ? "no" : "yes"}>
    <th role="rowheader" scope="row"><a href=${`#/axis/${axis.rig.name}/${axis.name}`}>${axis.name}</a>
      <small>${info.model} · ${info.address}</small></th>
    ${cell("State", html`<${StateWord} axis=${axis} />${
      state?.stop_pending
        ? html` <${Mark} level="bad">stop NOT confirmed<//>`
        : state?.stop_latched && html` <${Mark} level="warn">stop latched<//>`
    }`)}
    ${cell("Position", html`<${Place} axis=${axis} decimals=${decimals} />`, "number main")}
    ${cell("Velocity", html`${number(live ? axis.velocity : null, Math.min(decimals, 2))} <span class="unit">${info.unit}/s</span>`, "number")}
    ${cell("Target", number(live ? state?.command?.target : null, decimals), "number")}
    ${cell("A/D", adc ? html`${number(adc.volts, 2)} <span class="unit">V</span>` : html`<span class="quiet">none</span>`, "number")}
    ${cell("Faults", html`<${FaultWords} axis=${axis} />`)}
    ${cell("Values", html`<${QualityWord} axis=${axis} />${" "}
      <small>${number(health?.rate_hz, 1)} of ${number(health?.rate_wanted_hz, 1)} Hz</small>`)}
    ${cell("Control", html`<${HolderWord} axis=${axis} />`)}
    ${cell("Commands", html`<${AxisCommands} axis=${axis} />`, "commands")}
  </tr>${
    axis.refusal &&
    html`<tr role="row" class="refusal"><td role="cell" colspan=${COLUMNS.length}><${Mark} level="bad">${axis.name}: ${axis.refusal}<//></td></tr>`
  }`;
}

/** What can be asked of one axis without leaving the page; why not is in the title and read to screen readers. */
function AxisCommands({ axis }) {
  if (!axis.can("power")) return html`<span class="quiet">none</span>`;
  const on = axis.state?.enabled;
  const commands = [
    [on ? "Disable" : "Enable", on ? "disable" : "enable", () => command(axis, "power", { on: !on })],
    ["Reset", "reset", () => command(axis, "reset")],
    ["Home", "home", () => command(axis, "home")],
    ["Halt", "halt", () => command(axis, "halt")],
  ];
  return html`<span class="row" role="group" aria-label=${`Commands for ${axis.name}`}>
    ${commands.map(([title, act, run]) => html`<${ShortAction} key=${act} title=${title} name=${axis.name}
      act=${run} obstacle=${obstacle(axis, act)} />`)}
  </span>`;
}

function ShortAction({ title, name, act, obstacle: way }) {
  const reason = useId();
  return html`<${Action} act=${act} obstacle=${way} reason=${reason} title=${way ?? `${title} ${name}`}
    >${title}<span class="unseen"> ${name}</span><//>${way && html`<span class="unseen" id=${reason}>${way}</span>`}`;
}

/** Why an axis refused a command, with the nearest value that it would take. */
function refused(axis, verb, { message, nearest }) {
  const text = message.replace(`axis ${axis.name}: `, "");
  return `${words(verb)} refused: ${text}${nearest === null ? "" : `; nearest that is taken: ${nearest}`}`;
}

/** What can be asked of all axes of a rig at once; each one that cannot do it now is passed over. */
function RigCommands({ rig }) {
  const axes = [...rig.axes.values()].filter((axis) => axis.can("power"));
  const [from, setFrom] = useState(null); // consent to take them from these holders is none to take them from others
  const [told, setTold] = useState("");
  if (!axes.length) return null;
  const mine = axes.filter(controls);
  const others = axes.filter((axis) => !controls(axis) && axis.holder);
  const held = others.map(({ name, holder }) => `${name} is controlled by ${holder}`).join(", ");
  const force = others.length > 0 && from === held;
  const ready = (act) => axes.filter((axis) => obstacle(axis, act) === null);
  const each = (act, verb, body) => async () => {
    const asked = ready(act);
    for (const axis of axes) axis.refusal = null;
    const outcomes = await Promise.allSettled(asked.map((axis) => command(axis, verb, body)));
    outcomes.forEach(({ reason }, at) => {
      if (reason) asked[at].refusal = refused(asked[at], verb, reason);
    });
    for (const axis of axes) {
      const way = act === "home" && !asked.includes(axis) && obstacle(axis, act);
      if (way) axis.refusal = `${words(verb)} refused: ${way}`;
    }
    const failed = axes.filter((axis) => axis.refusal);
    setTold(failed.length ? `${words(verb)}: refused by ${failed.map(({ name }) => name).join(", ")}; the reasons are in their rows.` : `${verb === "power" ? (body.on ? "enabled" : "disabled") : verb}: ${asked.map(({ name }) => name).join(", ")}`);
  };
  const button = (title, act, verb, body) => html`<${ShortAction} title=${title} name="all" act=${each(act, verb, body)}
    obstacle=${ready(act).length ? null : (obstacle(axes[0], act) ?? "No axis can do that now.")} />`;
  return html`<div class="rig-commands" role="group" aria-label=${`Commands for all axes of ${rig.name}`}>
    <p class="row">
      ${mine.length < axes.length && html`<${Action} key="take" kind="main" act=${() => take(axes.filter((axis) => !controls(axis)), force)}
        obstacle=${obstacle(axes[0], "none") ?? (others.length && !force ? `${held}: tick to take it from there.` : null)}
        >Take control of all<//>`}
      ${mine.length > 0 && html`<${Action} key="release" act=${() => release(mine)} title="Axes that move are halted first">Release control<//>`}
      ${others.length > 0 && html`<${Tick} label="Take it from the others" checked=${force}
        onChange=${(on) => setFrom(on ? held : null)} />`}
      ${button("Enable", "enable", "power", { on: true })}
      ${button("Disable", "disable", "power", { on: false })}
      ${button("Reset", "reset", "reset", {})}
      ${button("Home", "home", "home", {})}
      ${button("Halt", "halt", "halt", {})}
    </p>
    <p role="status">${told}</p>
  </div>`;
}

/** Who controls an axis. */
export function HolderWord({ axis }) {
  if (controls(axis)) return html`<span class="mine">this page</span>`;
  return html`<span class=${axis.holder ? "" : "quiet"}>${axis.control}</span>`;
}
