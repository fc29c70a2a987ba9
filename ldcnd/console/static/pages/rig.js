/** The rig page: faults and warnings first, then every axis of every rig, one line each, and what can be asked of them. */

import { html, useState } from "../html.js";
import { Action, Choice, Facts, Swap, Tick } from "../parts/controls.js";
import { dateAndClock, words } from "../parts/format.js";
import { TextField } from "../parts/number_field.js";
import { askEach, Fates } from "../parts/fates.js";
import { problems } from "../parts/problems.js";
import { Mark } from "../parts/state.js";
import { ifUnheard } from "../parts/stop_all.js";
import { ask, Press } from "../session/api.js";
import { commandOfMany, controls, release, take } from "../session/control.js";
import { calms, isUseless, moves, obstacle, useless } from "../session/obstacles.js";
import { axesOf, changed, endpoints, isWhole, useRigs } from "../session/rigs.js";
import { AxesOf, refused, ShortAction } from "./rig_axes.js";
import { GroupMoves } from "./rig_groups.js";
import { ModulesOf } from "./rig_modules.js";
import { Sequences } from "./rig_sequences.js";
import { SpeedOverride } from "./rig_speed.js";

/** So many axes are found without a filter. */
const FEW = 6;
const MOST_PLACES = 8;
/** What the page shows, for as long as it is loaded. */
const view = { find: "", only: "", by: "line" };
const ONLY = {
  attention: ({ condition }) => condition.troubles.some(({ level }) => level),
  moving: ({ condition, state }) => !condition.live || state?.moving !== "no", // what does not answer may move
  unknown: ({ condition }) => !condition.known,
};

export function RigPage() {
  const all = [...useRigs().values()];
  return html`
    <h1 class="unseen">Rig</h1>
    <${Attention} rigs=${all} />
    ${axesOf().length > FEW && html`<${Filter} rigs=${all} />`}
    ${all.length ? all.map((rig) => html`<${RigSection} key=${rig.name} rig=${rig} />`) : html`<${NoRig} />`}
    <${Invitation} />`;
}

function Filter({ rigs }) {
  const set = (name) => (value) => {
    view[name] = value ?? "";
    changed();
  };
  const grouped = rigs.some((rig) => [...rig.axes.values()].some(({ info }) => info?.group));
  const shown = axesOf().filter((axis) => axis.info && wanted(axis)).length;
  return html`<div class="filter" role="search">
    <${TextField} label="Find axis" value=${view.find || null} onChange=${set("find")} />
    <${Choice} label="Show" value=${view.only} onChange=${set("only")}
      options=${[["", "all axes"], ["attention", "what needs attention"], ["moving", "what moves"], ["unknown", "what is not homed or does not answer"]]} />
    ${grouped && html`<${Choice} label="Together by" value=${view.by} onChange=${set("by")} options=${[["line", "line"], ["group", "group"]]} />`}
    <p class="quiet" role="status">${shown} of ${axesOf().filter(({ info }) => info).length} axes</p>
  </div>`;
}

function wanted(axis) {
  const { name, info, holder } = axis;
  const text = [name, info.model, info.group, info.bus, holder].join(" ").toLowerCase();
  return text.includes(view.find.trim().toLowerCase()) && (ONLY[view.only]?.(axis) ?? true);
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
  if (!isWhole()) return null;
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
      <span>${text}</span> <span class="places"><${Places} places=${places} /></span>
    </li>`,
    )}</ul>
  </section>`;
}

function Places({ places }) {
  const links = (some) => some.map(({ where, link, detail }) => html`<a href=${link}>${where}</a>${
    detail && html` <span class="quiet number">${detail}</span>`} `);
  if (places.length <= MOST_PLACES) return links(places);
  return html`${links(places.slice(0, MOST_PLACES))}<details><summary>${places.length - MOST_PLACES} more</summary>${links(places.slice(MOST_PLACES))}</details>`;
}

function RigSection({ rig }) {
  const axes = [...rig.axes.values()].filter((axis) => axis.info && wanted(axis));
  const of = (each) => (view.by === "group" ? (each.info.group ?? "") : each.info.bus);
  const parts = view.by === "group" ? [...new Set(axes.map(of))].sort() : [...rig.buses.keys()];
  const filtered = view.find || view.only;
  return html`<section class="rig" aria-label=${`Rig ${rig.name}`} data-stale=${rig.worth ? "yes" : "no"}>
    <header>
      <h2>${rig.name}</h2>
      <${Facts} of=${[
        ["daemon", rig.daemon && `ldcnd ${rig.daemon.version}`],
        ["since", rig.daemon && dateAndClock(rig.daemon.started).slice(0, -4)],
        ["at", rig.endpoint],
      ]} />
    </header>
    ${rig.worth && html`<p class="notice mark" data-level="bad">${rig.worth.why} The values below are the last known ones.</p>`}
    <${RigCommands} rig=${rig} />
    ${parts.map((part) => {
      const mine = axes.filter((axis) => of(axis) === part);
      const bus = view.by === "group" ? null : rig.buses.get(part);
      return (mine.length > 0 || !filtered) && html`<${AxesOf} key=${`${view.by} ${part}`} rig=${rig} name=${part} bus=${bus} axes=${mine} found=${Boolean(filtered)} />`;
    })}
    ${!filtered && [...rig.buses.values()].map((bus) => html`<${ModulesOf} key=${bus.name} rig=${rig} bus=${bus} />`)}
    ${filtered && !axes.length && html`<p class="quiet">No axis of this rig is like that.</p>`}
    <${Sequences} rig=${rig} />
    <${GroupMoves} rig=${rig} />
  </section>`;
}

/** What can be asked of all axes of a rig at once; each one that cannot do it now is passed over. */
function RigCommands({ rig }) {
  const axes = [...rig.axes.values()].filter((axis) => axis.can("power"));
  const [from, setFrom] = useState(null); // consent to take them from these holders is none to take them from others
  if (!axes.length) return null;
  const mine = axes.filter(controls);
  const others = axes.filter((axis) => !controls(axis) && axis.holder);
  const held = others.map(({ name, holder }) => `${name} is controlled by ${holder}`).join(", ");
  const force = others.length > 0 && from === held;
  // an axis that is homed gets another origin by homing it again: on an index mark whole turns away, where it is not near its own
  const wants = (axis, act) => (act === "home" ? !(axis.condition.known && axis.state?.referenced) : !isUseless(axis, act));
  const ready = (act) => axes.filter((axis) => wants(axis, act) && obstacle(axis, act) === null);
  const each = (title, act, verb, body) => async () => {
    const pressed = new Press();
    // what forbade it before this page had control may not be told anew yet: the daemon refuses what it must
    const wanted = axes.filter((axis) => wants(axis, act) && (obstacle(axis, act) === null || (controls(axis) && !axis.rig.worth)));
    const relieves = calms(axes[0], act);
    const asked = relieves ? movingFirst(wanted.length ? wanted : axes) : wanted;
    // whether they stand already, and nothing is on its way to them, the daemon knows
    const rest = relieves ? axes.filter((axis) => !asked.includes(axis)) : [];
    for (const axis of axes) {
      const way = wants(axis, act) && !asked.includes(axis) && obstacle(axis, act);
      axis.refusal = way ? `${words(verb)} not sent: ${way}` : null;
    }
    if (relieves) for (const axis of axes) axis.notePress();
    const refuse = (axis) => (error) => { axis.refusal = refused(axis, verb, error); };
    const send = async (axis) => {
      try {
        return await commandOfMany(axis, verb, body, pressed);
      } catch (error) {
        if (relieves) ifUnheard(axis, act, title, refuse(axis))(error); // before all others have answered
        else refuse(axis)(error);
        throw error;
      }
    };
    const told = askEach(rig.name, title, asked, send);
    for (const axis of movingFirst(rest)) commandOfMany(axis, verb, body, pressed).catch(ifUnheard(axis, act, title, () => {}));
    await told;
    changed();
  };
  // those too that a filter hides: it says so in sight
  const button = (title, act, verb, body) => html`<${ShortAction} title=${title} name="all" named calms=${calms(axes[0], act)}
    act=${each(title, act, verb, body)} obstacle=${ready(act).length ? null : wayOfAll(axes, act, wants)} />`;
  return html`<div class="rig-commands" role="group" aria-label=${`Commands for all axes of ${rig.name}`}>
    <div class="row">
      <${Swap}>${mine.length < axes.length && html`<${Action} key="take" kind="main" act=${() => take(axes.filter((axis) => !controls(axis)), force)} onDone=${() => setFrom(null)}
        obstacle=${obstacle(axes[0], "none") ?? (others.length && !force ? `${held}: tick to take it from there.` : null)}
        >Take control of all<//>`}
      ${mine.length > 0 && html`<${Action} key="release" act=${() => release(mine)} title="Axes that move are halted first">Release control<//>`}<//>
      ${others.length > 0 && html`<${Tick} label="Take it from the others" checked=${force}
        onChange=${(on) => setFrom(on ? held : null)} />`}
      ${button("Enable", "enable", "power", { on: true })}
      ${button("Disable", "disable", "power", { on: false })}
      ${button("Reset", "reset", "reset", {})}
      ${button("Home", "home", "home", {})}
      ${button("Halt", "halt", "halt", {})}
      <${SpeedOverride} rig=${rig} />
    </div>
    <${Fates} place=${rig.name} />
  </div>`;
}

/** In the order in which they are to come to rest: what moves, then what may move, then what is seen to stand. */
function movingFirst(axes) {
  const rank = (axis) => (moves(axis) ? 0 : axis.condition.live && axis.state?.moving === "no" ? 2 : 1);
  return [...axes].sort((one, other) => rank(one) - rank(other));
}

/** Why a command for all axes would do nothing now: no axis wants it, or what is in the way of each that does. */
function wayOfAll(axes, act, wants) {
  const wanting = axes.filter((axis) => wants(axis, act));
  if (!wanting.length) return act === "home" ? "Every axis is homed: home one again on its page." : useless(axes[0], act);
  const ways = new Map();
  for (const axis of wanting) {
    const way = obstacle(axis, act).replaceAll(`axis ${axis.name}:`, "").replaceAll(`axis ${axis.name}`, "it").trim();
    ways.set(way, [...(ways.get(way) ?? []), axis.name]);
  }
  return [...ways].map(([way, names]) => `${names.join(", ")}: ${way}`).join(" ");
}
