/** What has happened: every command of every rig, how it ended, and who sent it; faults, and starts of daemons. */

import { html, useEffect, useState } from "../html.js";
import { Action, Choice, Panel, RefusalText, Table } from "../parts/controls.js";
import { TextField } from "../parts/number_field.js";
import { save } from "../parts/chart_view.js";
import { dateAndClock, words } from "../parts/format.js";
import { faultPage, Mark } from "../parts/state.js";
import { COMMAND_STATUSES } from "../session/contract.js";
import { LONGEST_AGO_S } from "./network_wire_log.js";
import { learnAllEvents, useRigs } from "../session/rigs.js";

const MOST_SHOWN = 300;
/** Between two samples of a trace that is as fast as the line allows, at most, in seconds. */
const SLOWEST_LINE_S = 0.05;
const LEVELS = { refused: "warn", aborted: "warn", failed: "bad", unknown: "bad", fault: "bad" };

export function EventsPage() {
  const all = [...useRigs().values()];
  const [only, setOnly] = useState({ axis: "", status: "", text: "" });
  const [refusal, setRefusal] = useState(null);
  const connected = all
    .filter((rig) => rig.connected)
    .map((rig) => `${rig.name} ${rig.daemon?.instance}`)
    .join();
  useEffect(() => {
    for (const rig of all) if (rig.connected) learnAllEvents(rig).catch(setRefusal);
  }, [connected]);

  const set = (name) => (value) => setOnly((last) => ({ ...last, [name]: value ?? "" }));
  const axes = all
    .flatMap((rig) => [...rig.axes.values()])
    .map((axis) => [`${axis.rig.name}/${axis.name}`, `${axis.rig.name} · ${axis.name}`]);
  const found = all
    .flatMap((rig) => [...rig.events, ...faultsOf(rig), ...startOf(rig)].map((event) => ({ rig, event })))
    .filter((each) => matches(each, only))
    .sort((one, other) => other.event.t - one.event.t);

  return html`<h1>Events</h1>
    <${Panel} title="Commands and how they ended">
      <div class="fields">
        <${Choice} label="Axis" options=${[["", "all"], ...axes]} value=${only.axis} onChange=${set("axis")} />
        <${Choice} label="Status" options=${[["", "all"], ...[...COMMAND_STATUSES, "fault", "started"].map((each) => [each, each])]}
          value=${only.status} onChange=${set("status")} />
        <${TextField} label="Find" type="search" value=${only.text || null} onChange=${set("text")} />
      </div>
      <p class="row"><${Action} act=${() => save(new Blob([csvOf(found)], { type: "text/csv" }), "events.csv")}
        obstacle=${found.length ? null : "There is nothing to save."}>Save CSV<//></p>
      <${RefusalText} refusal=${refusal} />
      ${all.filter((rig) => rig.eventsBegin?.t).map((rig) => html`<p class="quiet">${lostOf(rig)}</p>`)}
      <p class="quiet" role="status">${found.length} events${found.length > MOST_SHOWN ? `, the latest ${MOST_SHOWN} are shown` : ""}.</p>
      <${Table} label="Events" head=${["When", "Axis", "Command", "Status", "By", "Reason", "More"]}
        rows=${found.slice(0, MOST_SHOWN).map(Row)} />
    <//>`;
}

function Row({ rig, event }) {
  return html`<tr key=${`${rig.name}/${event.axis}/${event.seq ?? event.code}/${event.t}`}>
    <td class="time">${dateAndClock(event.t)}</td>
    <td>${!event.axis ? rig.name : !rig.axes.get(event.axis)?.info ? event.axis : html`<a href=${`#/axis/${rig.name}/${event.axis}`}>${event.axis}</a>`}</td>
    <td>${whatOf(event)}</td><td><${Mark}
      level=${LEVELS[event.status] ?? ""}>${event.status}<//></td><td>${event.client ?? "–"}</td>
    <td>${[event.reason, way(event)].filter(Boolean).join("; ")}${event.code && html` <a href=${faultPage(event.code)}>${event.code}</a>`}</td>
    <td><${Around} rig=${rig} event=${event} /></td></tr>`;
}

/** Where to see more of that moment: packets of the line while they are kept, and a trace that was under way. */
function Around({ rig, event }) {
  const axis = rig.axes.get(event.axis);
  if (!axis?.info) return null;
  const of = html`<span class="unseen"> of ${event.axis} at ${dateAndClock(event.t)}</span>`;
  const kept = (rig.nowNs() - event.t) / 1e9 < LONGEST_AGO_S;
  return html`${kept && html`<a href=${`#/network/${rig.name}/${axis.info.bus}/${event.t}`}>wire log${of}</a> `}${
    isTraced(axis.trace, event.t) && html`<a href=${`#/trace/${rig.name}/${event.axis}`}>trace${of}</a>`}`;
}

/** Whether an instant lies in the last trace of an axis, as far as its header tells. */
function isTraced(trace, t) {
  if (trace?.phase !== "complete") return false;
  const { interval_s: interval, samples, pre_trigger: before } = trace;
  const eachS = interval || SLOWEST_LINE_S;
  return trace.t - before * eachS * 1e9 <= t && t <= trace.t + (samples - before) * eachS * 1e9;
}

/** What it was, in words: of `power`, which way. */
function whatOf({ verb, on }) {
  return `${words(verb)}${on === null || on === undefined ? "" : on ? " on" : " off"}`;
}

/** The faults of the axes of a rig, those that are over too, as events. */
function faultsOf(rig) {
  const axes = [...rig.axes.values()].filter(({ info }) => info);
  return axes.flatMap((axis) => {
    const seen = new Map([...axis.info.past_faults, ...axis.faults].map((fault) => [`${fault.code} ${fault.since}`, fault]));
    return [...seen.values()].map(({ code, since, text }) => ({ t: since, axis: axis.name, verb: "fault", status: "fault", reason: text, code }));
  });
}

/** What became of the events before those that the daemon knows. */
function lostOf({ name, events, eventsBegin: { t, discarded } }) {
  const before = `vents of ${name} before ${dateAndClock(t)}`;
  const lost = discarded ? `The ${discarded} e${before} are not kept any more` : `E${before} are not known: its daemon began then`;
  const seen = events.length && events[0].t < t ? ", but for those that this page has seen" : "";
  return `${lost}${seen}. A recorder keeps them: ldcnd record.`;
}

/** The start of the daemon: what an earlier run of it has done is not known any more. */
function startOf({ daemon }) {
  if (!daemon) return [];
  return [{ t: daemon.started, axis: "", verb: "daemon", status: "started", reason: `ldcnd ${daemon.version}, run ${daemon.instance}` }];
}

/** Where a motion was to go, and where the axis came to rest or was read last. */
function way({ target, position, last_position: last, following_error: off, settled }) {
  const rest = settled == null || off == null ? "" : `, ${Number(off.toPrecision(3))} off its target`;
  return [
    target != null && `to ${Number(target.toPrecision(7))}`,
    position != null && `at ${Number(position.toPrecision(7))}${rest}${settled === false ? ", not settled" : ""}`,
    last != null && `last read at ${Number(last.toPrecision(7))}`,
  ]
    .filter(Boolean)
    .join(", ");
}

function matches({ rig, event }, { axis, status, text }) {
  if (axis && axis !== `${rig.name}/${event.axis}`) return false;
  if (status && status !== event.status) return false;
  return [event.axis, whatOf(event), event.client, event.reason, event.code, event.command_id]
    .join(" ")
    .toLowerCase()
    .includes(text.toLowerCase());
}

function csvOf(found) {
  const cell = (value) => `"${String(value ?? "").replaceAll('"', '""')}"`;
  const rows = found.map(({ rig, event }) =>
    [
      dateAndClock(event.t),
      rig.name,
      event.axis,
      whatOf(event),
      event.status,
      event.client,
      event.reason,
      event.code,
      event.command_id,
      event.target,
      event.position,
      event.last_position,
    ]
      .map(cell)
      .join(),
  );
  return `${["when,rig,axis,command,status,client,reason,code,command_id,target,position,last_position", ...rows].join("\n")}\n`;
}
