/** The lines: who is on them, what they promise, how they do, and what was on the wire. */

import { html } from "../html.js";
import { Facts, Panel, Table } from "../parts/controls.js";
import { duration, number, percent } from "../parts/format.js";
import { Mark } from "../parts/state.js";
import { useRigs } from "../session/rigs.js";
import { Guests } from "./network_guests.js";
import { Modules, Snapshot } from "./network_io.js";
import { WireLog } from "./network_wire_log.js";

const COUNTERS = [
  "exchanges",
  "timeouts",
  "corrupt_replies",
  "rejected_packets",
  "resent",
  "resynchronisations",
  "stray_bytes",
  "losses",
];

export function NetworkPage({ at }) {
  const lines = [...useRigs().values()].flatMap((rig) => [...rig.buses.values()].map((bus) => ({ rig, bus })));
  return html`<h1>Network</h1>
    ${lines.length ? lines.map(({ rig, bus }) => html`<${Line}
      key=${`${rig.name}/${bus.name}`} rig=${rig} bus=${bus}
      instant=${rig.name === at.rig && bus.name === at.axis ? at.instant : null} />`) : html`<p>No line is known yet.</p>`}`;
}

function Line({ rig, bus, instant }) {
  const { info } = bus;
  const plan = rig.plan?.buses.find((each) => each.bus === bus.name);
  if (!info) return null;
  return html`<${Panel} title=${`${rig.name} · ${bus.name}`} of=${rig}>
    ${bus.up ? null : html`<p class="notice mark" data-level="bad">Down: ${info.problem || "its drives are not polled."}</p>`}
    ${info.remarks.map((remark) => html`<p class="quiet">At the start: ${remark}.</p>`)}
    <${Facts} of=${[
      ["port", info.port],
      ["rate", `${info.baud} baud`],
      ["state", rig.worth ? `unknown, was ${bus.up ? "up" : "down"}` : bus.up ? "up" : "down"],
      ["drives were", { reset: "reset: positions count from 0", adoption: "taken over as they were" }[info.started_by]],
      ["in use", percent(bus.health?.utilisation)],
      ["99 % of polls within", duration(info.poll_p99_s)],
      ["99 % of stops within", info.stop_longest_s ? duration(info.stop_p99_s) : "no stop yet"],
      ["longest stop", info.stop_longest_s ? duration(info.stop_longest_s) : "no stop yet"],
    ]} />
    <h3>Chain</h3>
    <${Chain} rig=${rig} bus=${bus} />
    <div class="columns">
      <div class="column"><h3>Health</h3><${Health} rig=${rig} bus=${bus} /></div>
      <div class="column"><h3>Plan</h3>${plan ? html`<${Plan} rig=${rig} plan=${plan} />` : html`<p class="quiet">This line is polled one drive after the other; nothing is promised.</p>`}</div>
    </div>
    <${Guests} rig=${rig} bus=${bus} />
    <${Modules} rig=${rig} bus=${bus} />
    <${Snapshot} rig=${rig} bus=${bus.name} />
    <h3>Wire log</h3>
    <${WireLog} rig=${rig} bus=${bus.name} instant=${instant} />
  <//>`;
}

function Chain({ rig, bus }) {
  const found = bus.info.modules.length
    ? bus.info.modules
    : [...rig.axes.values()]
        .filter((axis) => axis.info?.bus === bus.name)
        .map(({ info }) => ({
          address: info.address,
          title: info.identity ?? "has not answered",
          model: info.model,
          axis: info.axis,
        }));
  const rows = found.map(
    (module) => html`<tr>
    <th scope="row">${module.address}</th>
    <td>${module.axis ? html`<a href=${`#/axis/${rig.name}/${module.axis}`}>${module.axis}</a>` : html`<span class="quiet">no axis</span>`}</td>
    <td>${module.title}</td>
    <td>${module.model ?? html`<${Mark} level="warn">not described: never moved<//>`}</td>
    <td class="number">${module.device_id === undefined ? "–" : `${module.device_id}, version ${module.version}`}</td>
  </tr>`,
  );
  return html`<${Table} label=${`Chain of ${rig.name} on ${bus.name}`}
    head=${["Address", "Axis", "Identity", "Model", "#Device"]} rows=${rows} />`;
}

function Health({ rig, bus }) {
  const { health } = bus;
  if (!health) return html`<p class="quiet">No report yet.</p>`;
  const lanes = health.lanes.map(
    (lane) => html`<tr><th scope="row">${lane.lane}</th>
    <td class="number">${lane.waiting}</td><td class="number">${lane.exchanges}</td>
    <td class="number">${duration(lane.p50_s)}</td><td class="number">${duration(lane.p99_s)}</td><td class="number">${duration(lane.longest_s)}</td></tr>`,
  );
  const counters = COUNTERS.map((name) => {
    const lately = bus.lately(name);
    return [
      name.replaceAll("_", " "),
      html`${health[name]} <span class=${lately && name !== "exchanges" ? "mark" : "quiet"} data-level="warn">+${lately}</span>`,
    ];
  });
  return html`<${Table} label=${`Lanes of ${rig.name} on ${bus.name}`}
    head=${["Lane", "#Waiting", "#Replies", "#Half within", "#99 % within", "#Longest"]} rows=${lanes} />
    <p class="quiet">Since the daemon started, and within the last minute:</p>
    <${Facts} of=${counters} />`;
}

function Plan({ rig, plan }) {
  const polls = plan.polls.map(
    (poll) => html`<tr><th scope="row">${poll.axis}</th>
    <td class="number">${number(poll.rate_hz, 1)} Hz</td><td class="number">${poll.request_bytes} + ${poll.reply_bytes}</td>
    <td class="number">${duration(poll.longest_s)}</td><td class="number">${duration(poll.response_s)}</td>
    <td><${Mark} level=${poll.holds ? "" : "warn"}>${poll.holds ? "holds" : "can be late"}<//></td></tr>`,
  );
  return html`<${Facts} of=${[
    ["polls take", `${percent(plan.mean_load)} on average, ${percent(plan.load)} at most`],
    ["room for", `${number(plan.commands_per_s, 0)} commands a second`],
    ["stop answered within", duration(plan.stop_s)],
    ["after a lost reply", duration(plan.stop_after_loss_s)],
  ]} />
    <${Table} label=${`Polls of ${rig.name} on ${plan.bus}`}
      head=${["Axis", "#Rate", "#Bytes", "#Takes", "#Done within", "Verdict"]} rows=${polls} />
    ${plan.remedies.map((remedy) => html`<p class="mark" data-level="warn">${remedy}</p>`)}`;
}
