/** The axes of a line or of a group, one line each: state, homed, place, and the commands that make sense now. */

import { html, useId } from "../html.js";
import { Action } from "../parts/controls.js";
import { askEach } from "../parts/fates.js";
import { decimalsOf, number, percent, words } from "../parts/format.js";
import { shownQuantity } from "../parts/number_text.js";
import { inPageTerms, pageOf } from "../parts/remedies.js";
import { Homed, Mark, Meter, Place, placed, StateWord, TroubleWords } from "../parts/state.js";
import { ifUnheard } from "../parts/stop_all.js";
import { command, controls, take } from "../session/control.js";
import { calms, obstacle } from "../session/obstacles.js";
import { changed } from "../session/rigs.js";

const COLUMNS = ["Axis", "State", "Position", "Homed", "Velocity", "Target", "Following error", "Control", "Commands"];
const FULL = 0.9;
const COUNTERS = [
  ["timeouts", "timeouts"],
  ["corrupt_replies", "corrupt"],
  ["rejected_packets", "rejected"],
  ["resent", "retries"],
  ["resynchronisations", "resyncs"],
  ["losses", "port losses"],
];
/** The parts that a person has folded or opened, by rig and name; on a phone those of a large rig begin folded. */
const opened = new Map();
const MANY = 12;
const narrow = matchMedia("(width < 50rem)");

/** A part of a rig; `bus` where it is a line, `found` where somebody looks for these axes. */
export function AxesOf({ rig, name, bus, axes, found = false }) {
  const key = `${rig.name} ${name}`;
  const open = found || (opened.get(key) ?? !(narrow.matches && rig.axes.size > MANY));
  const toggle = () => {
    opened.set(key, !open);
    changed();
  };
  const title = bus ? `Line ${name} of ${rig.name}` : name ? `Group ${name} of ${rig.name}` : `Axes of ${rig.name} without a group`;
  return html`<section class="bus" aria-label=${title}>
    <header class="bus-line">
      <h3><button type="button" class="fold" aria-expanded=${open ? "true" : "false"} onClick=${toggle}>${name || "no group"}</button></h3>
      ${bus && html`<${LineNow} rig=${rig} bus=${bus} />`}
      <span class="quiet">${inBrief(axes)}</span>
    </header>
    ${open && html`<table class="axes" role="table" aria-label=${`Axes of ${title.replace(/^Line /, "")}`}>
      <thead role="rowgroup"><tr role="row">${COLUMNS.map((each) => html`<th role="columnheader" scope="col">${each}</th>`)}</tr></thead>
      <tbody role="rowgroup">${axes.map((axis) => html`<${AxisRow} key=${axis.name} axis=${axis} />`)}</tbody>
    </table>`}
  </section>`;
}

/** How many axes there are, and how many of them do what one looks for. */
function inBrief(axes) {
  const count = (is) => axes.filter(is).length;
  const parts = [
    [count(({ state, condition }) => condition.live && state?.moving === "yes"), "moving"],
    [count(({ condition }) => !condition.known), "without a known place"],
    [count(({ condition }) => condition.troubles.some(({ level }) => level === "bad")), "with a fault"],
  ];
  const said = parts.filter(([number]) => number > 0).map(([number, what]) => `, ${number} ${what}`);
  return `${axes.length} ${axes.length === 1 ? "axis" : "axes"}${said.join("")}`;
}

function LineNow({ rig, bus }) {
  const { info, health } = bus;
  const up = rig.worth ? null : bus.up;
  const grown = COUNTERS.filter(([counter]) => bus.lately(counter) > 0);
  return html`<${Mark} level=${up === false ? "bad" : ""}>${up === null ? "unknown" : up ? "up" : "down"}<//>
    <span class="quiet">${info?.port}, ${info?.baud} baud</span>
    ${up && html`<${Meter} label="in use" share=${health?.utilisation} text=${percent(health?.utilisation)}
      level=${health?.utilisation > FULL ? "warn" : ""} />`}
    ${grown.length > 0 && html`<ul class="counters" aria-label="Link quality">${grown.map(
      ([counter, label]) => html`<li><span class="quiet">${label} in the last minute</span> <b>${bus.lately(counter)}</b></li>`,
    )}</ul>`}`;
}

function AxisRow({ axis }) {
  const { info, samples, state } = axis;
  const decimals = decimalsOf(info);
  const { live, troubles } = axis.condition;
  const velocity = shownQuantity(live ? axis.velocity : null, info, "velocity");
  const cell = (label, content, kind = "", title = null) => html`<td role="cell" data-label=${label} class=${kind} title=${title}>${content}</td>`;
  return html`<tr role="row" data-axis=${axis.name} data-stale=${live ? "no" : "yes"}>
    <th role="rowheader" scope="row"><a href=${`#/axis/${axis.rig.name}/${axis.name}`}>${axis.name}</a>
      <small>${info.model} · ${info.address}</small></th>
    ${cell("State", html`<${StateWord} axis=${axis} /><${TroubleWords} axis=${axis} />`,
      "said", [axis.condition.state, ...troubles.map(({ text }) => text)].join(". "))}
    ${cell("Position", html`<${Place} axis=${axis} decimals=${decimals} label="Position" />`, "number main")}
    ${cell("Homed", html`<${Homed} axis=${axis} />`, "homed")}
    ${cell("Velocity", html`${number(velocity.value, Math.min(decimals, 2))}<span class="unit"> ${velocity.unit}</span>${velocity.acts && html` <small class="acts">${velocity.acts}</small>`}`, "number")}
    ${cell("Target", placed(axis, live ? state?.command?.target : null, decimals), "number")}
    ${cell("Following error", number(live ? samples.position?.following_error : null, decimals), "number")}
    ${cell("Control", html`<${HolderWord} axis=${axis} />`, "holder", axis.control)}
    ${cell("Commands", html`<${AxisCommands} axis=${axis} />`, "commands")}
  </tr>${
    axis.refusal &&
    html`<tr role="row" class="refusal"><td role="cell" colspan=${COLUMNS.length}><${Mark} level="bad">${axis.name}: ${axis.refusal}<//></td></tr>`
  }`;
}

/** Why an axis refused a command, what to do, and the nearest value that it would take. */
export function refused(axis, verb, { message, nearest, remedy, steps }) {
  const text = message.replace(`axis ${axis.name}: `, "");
  const way = remedy ? `; ${inPageTerms({ remedy, steps, axis: axis.name })}` : "";
  return `${words(verb)} refused: ${text}${nearest === null ? way : `; nearest that is taken: ${nearest}`}`;
}

/** What can be asked of one axis without leaving the page; why not is in the title and read to screen readers.

 * Of the commands that the daemon would carry out now: without control that is to take it.
 */
function AxisCommands({ axis }) {
  if (!axis.can("power")) return html`<span class="quiet">none</span>`;
  const on = axis.state?.enabled;
  const halt = ["Halt", "halt", () => command(axis, "halt")];
  const power = [on ? "Disable" : "Enable", on ? "disable" : "enable", () => command(axis, "power", { on: !on })];
  const reset = ["Reset", "reset", () => command(axis, "reset")];
  const home = ["Home", "home", () => follow("Home", () => command(axis, "home"))];
  const second = obstacle(axis, "reset") === null || !axis.can("home") ? reset : home;
  const taking = ["Take control", "none", () => take([axis])];
  const held = axis.holder ? `Control is held by ${axis.holder}: take it on ${pageOf(axis.name)}.` : null;
  const refuse = (title, act) => {
    const tell = (error) => {
      axis.refusal = refused(axis, title.toLowerCase(), error); // below the row, which is one line
      changed();
    };
    return calms(axis, act) ? ifUnheard(axis, act, title, tell) : tell;
  };
  const follow = async (title, send) => {
    for (const { error } of await askEach(axis.rig.name, title, [axis], send)) throw error;
  };
  const begin = (act, run) => () => {
    axis.refusal = null;
    if (calms(axis, act)) axis.notePress();
    return run();
  };
  return html`<span class="row" role="group" aria-label=${`Commands for ${axis.name}`}>
    ${(controls(axis) ? [power, second, halt] : [taking, halt]).map(([title, act, run]) => html`<${ShortAction} key=${act} title=${title}
      name=${axis.name} calms=${calms(axis, act)} act=${begin(act, run)} onRefused=${refuse(title, act)} obstacle=${obstacle(axis, act) ?? (act === "none" ? held : null)} />`)}
  </span>`;
}

/** A small button for what `name` says, in sight where it is `named`; what is in its way is in the title and read to
 * screen readers.
 */
export function ShortAction({ title, name, named = false, act, calms: relieves, onRefused, obstacle: way }) {
  const reason = useId();
  return html`<${Action} calms=${relieves} act=${act} onRefused=${onRefused} obstacle=${way} reason=${reason} title=${way ?? `${title} ${name}`}
    >${named ? `${title} ${name}` : html`${title}<span class="unseen"> ${name}</span>`}<//>
    ${way && html`<span class="unseen" id=${reason}>${way}</span>`}`;
}

/** Who controls an axis. */
export function HolderWord({ axis }) {
  if (controls(axis)) return html`<span class="mine">this page</span>`;
  return html`<span class=${axis.holder ? "" : "quiet"}>${axis.control}</span>`;
}
