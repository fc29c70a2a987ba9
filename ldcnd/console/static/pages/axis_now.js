/** What an axis does now: its values large, its status bits decoded. */

import { html, useState } from "../html.js";
import { Action, Facts, Panel } from "../parts/controls.js";
import { age, clock, decimalsOf, number, words } from "../parts/format.js";
import { shownQuantity } from "../parts/number_text.js";
import { EndOfMotion } from "../parts/motion_story.js";
import { Lamp, Mark, placed, QualityWord, StateWord } from "../parts/state.js";
import { readSignals, signalsOf } from "../session/captures.js";
import { obstacle } from "../session/obstacles.js";

export function NowPanel({ axis }) {
  const { info, samples, state } = axis;
  const decimals = decimalsOf(info);
  const { position, adc } = samples;
  const { known, live, mark } = axis.condition;
  const velocity = shownQuantity(live ? axis.velocity : null, info, "velocity");
  const target = live ? state?.command?.target : null;
  const left = target == null || !position || info.modulo ? null : target - position.value; // a turn may lie between
  return html`<${Panel} title="Now" of=${axis.rig} data-stale=${live ? "no" : "yes"}>
    <div class="now">
      <p class="big" data-known=${known ? "yes" : "no"}><output aria-label="Position" aria-live="off"
        >${placed(axis, position?.value, decimals)}</output>
        <span class="unit">${info.unit}</span></p>
      ${!known && html`<p class="place-mark"><${Mark} level=${live ? "warn" : "bad"}>${mark}<//></p>`}
      <p class="now-state"><${StateWord} axis=${axis} /> <${QualityWord} axis=${axis} /></p>
    </div>
    <${Facts} of=${[
      ["velocity", html`${number(velocity.value, decimals)} <span class="unit">${velocity.said}</span>`],
      ["following error", html`${number(live ? position?.following_error : null, decimals)} <span class="unit">${info.unit}</span>`],
      ["target", html`${placed(axis, target, decimals)} <span class="unit">${info.unit}</span>`],
      ["left to go", html`${number(left, decimals)} <span class="unit">${info.unit}</span>`],
      ["encoder", html`${number(position?.counts, 0)} <span class="unit">count</span>`],
      ["A/D input", adc ? html`${number(adc.volts, 3)} <span class="unit">V</span> (${adc.counts})` : "none"],
      ["command", state?.command ? `${words(state.command.verb)}, ${remaining(state.command, axis.rig.nowNs())}` : "none"],
      ["last motion", html`<${LastMotion} axis=${axis} />`],
    ]} />
    <h3>Status</h3>
    <${StatusLamps} state=${state} live=${live} silent=${axis.rig.worth} />
    <${Inputs} axis=${axis} live=${live} />
    <${Monitors} axis=${axis} />
    <${Signals} axis=${axis} />
  <//>`;
}

function LastMotion({ axis }) {
  const unseen = axis.endedUnseen();
  if (unseen) return html`${words(unseen.verb)}: <${Mark} level="warn">not known how it ended<//>, the daemon was started again`;
  return axis.ended() ? html`<${EndOfMotion} axis=${axis} event=${axis.ended()} />` : "none known";
}

function remaining(command, nowNs) {
  if (!command.expected_end) return `for ${age((nowNs - command.since) / 1e9)}`;
  return `ends in ${age(Math.max(0, (command.expected_end - nowNs) / 1e9))}`;
}

function StatusLamps({ state, live, silent }) {
  const now = live ? state : null; // what is latched stays true of an axis that does not answer
  return html`<ul class="lamps" aria-label="Status bits">
    <${Lamp} label="loop closed" on=${now?.enabled} />
    ${(state?.has_reference ?? true) && html`<${Lamp} label="homed" on=${now?.referenced} level="" />`}
    <${Lamp} label="moving" on=${now && now.moving !== "unknown" ? now.moving === "yes" : null} />
    <${Lamp} label="answers" on=${state && live && state.link !== "down"} yes=${state?.link} no="down"
      level=${state?.link === "degraded" ? "warn" : ""} />
    <${Lamp} label="stop latched" on=${state?.stop_latched || (silent ? null : state?.stop_latched)} level="warn" />
    ${state?.stop_pending && html`<${Lamp} label="stop confirmed by the drive" on=${true} yes="NO" level="bad" />`}
    <${Lamp} label="error stop" on=${now && now.state === "error_stop"} level="bad" />
  </ul>`;
}

/** What every poll carries. A drive shows some inputs only while its motor is on, others only while it is off. */
function Inputs({ axis, live }) {
  const sample = axis.samples.inputs;
  if (!sample) return null;
  const tripped = axis.info.limit_stop; // the level at which the drive stops, where it does
  const limits = tripped === "high" ? ["tripped", "clear"] : tripped === "low" ? ["clear", "tripped"] : ["high", "low"];
  // a drive that has tripped keeps the enable bit, and its motor off: what it shows then is why it has tripped
  const isOpen = sample.amplifier_enable && axis.state?.state === "error_stop" && !axis.state.enabled;
  const lamp = (name, yes, no, off) => html`<${Lamp} label=${words(name)} on=${live ? sample[name] : null} yes=${yes} no=${no}
    unknown=${live ? `not shown ${isOpen ? "before reset" : `while ${off}`}` : "unknown"} />`;
  return html`<h3>Inputs</h3>
    <ul class="lamps" aria-label="Inputs">
      ${lamp("reverse_limit", ...limits, "disabled")}${lamp("forward_limit", ...limits, "disabled")}${lamp("index", "high", "low", "disabled")}
      ${lamp("stop_input", "open", "closed", "enabled")}${lamp("amplifier_enable", isOpen ? "set, motor off" : "on", "off", "not known to the daemon")}
    </ul>`;
}

function Monitors({ axis }) {
  const monitors = Object.entries(axis.monitors);
  if (!monitors.length) return null;
  return html`<h3>Monitors</h3>
    <${Facts} of=${monitors.map(([name, sample]) => [
      sample.title,
      sample.unit || !sample.high
        ? html`${number(sample.value, 0)} <span class="unit">${sample.unit}</span>`
        : sample.active
          ? `${sample.active.join(", ") || "none"} on (high: ${sample.high.join(", ") || "none"})`
          : sample.high.join(", ") || "none on",
    ])} />`;
}

/** A trace of two samples reads the drive's status bits as well. */
function Signals({ axis }) {
  const [snapshot, setSnapshot] = useState(null);
  const names = signalsOf(axis).filter((name) => !(name in (axis.samples.inputs ?? {}))); // those are live above
  if (axis.info.family === "smartstep" || !names.length) return null;
  return html`<h3>Drive signals</h3>
    ${snapshot && html`<ul class="lamps" aria-label="Drive signals">
      ${names.map((name) => html`<${Lamp}
        label=${words(name)} on=${snapshot.values[name] ?? null} yes="high" no="low" />`)}
    </ul>`}
    <p class="row"><${Action} act=${() => readSignals(axis)} obstacle=${obstacle(axis, "trace")}
      onDone=${setSnapshot}>Read signals<//>
      <small>${snapshot ? `As they were at ${clock(snapshot.at)}.` : "Takes a trace of two samples; it replaces the last trace."}</small></p>`;
}
