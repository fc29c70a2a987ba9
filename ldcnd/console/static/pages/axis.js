/** The page of one axis: what it does now, and what can be asked of it. */

import { html } from "../html.js";
import { NotThere } from "../parts/one_axis.js";
import { axisNamed, useRigs } from "../session/rigs.js";
import { AuthorityPanel } from "./axis_authority.js";
import { FaultPanel, WhyPanel } from "./axis_faults.js";
import { GainsPanel } from "./axis_gains.js";
import { HomePanel } from "./axis_homing.js";
import { LimitsPanel, RegistersPanel } from "./axis_limits.js";
import { JogPanel } from "./axis_jog.js";
import { MovePanel } from "./axis_motion.js";
import { NowPanel } from "./axis_now.js";
import { OutputsPanel } from "./axis_outputs.js";
import { ShadowPanel } from "./axis_shadow.js";

export function AxisPage({ at }) {
  useRigs();
  const axis = axisNamed(at);
  if (!axis) return html`<h1>Axis ${at.axis}</h1><${NotThere} at=${at} />`;
  const { info } = axis;
  return html`
    <header class="title">
      <h1><a href="#/rig">${axis.rig.name}</a> <span class="quiet">/</span> ${axis.name}</h1>
      <p class="quiet">${info.identity ?? info.model}, address ${info.address} on ${info.bus}</p>
      <p class="links"><a href=${`#/scope/${axis.rig.name}/${axis.name}`}>Scope</a> <a href=${`#/trace/${axis.rig.name}/${axis.name}`}>Trace</a>
        ${axis.can("set_gains") && html` <a href=${`#/tuning/${axis.rig.name}/${axis.name}`}>Tuning</a>`}
        ${axis.can("list_parameters") && html` <a
          href=${`#/parameters/${axis.rig.name}/${axis.name}`}>Parameters</a>`}</p>
    </header>
    ${axis.rig.worth && html`<p class="notice mark" data-level="bad">${axis.rig.worth.why} The values below are the last known ones.</p>`}
    <${FaultPanel} axis=${axis} />
    <div class="columns work">
      <div class="column">
        <${AuthorityPanel} axis=${axis} />
        ${axis.can("jog") && html`<${JogPanel} key=${axis.name} axis=${axis} />`}
        <${MovePanel} axis=${axis} />
        ${axis.can("home") && html`<${HomePanel} axis=${axis} />`}
        ${axis.can("set_outputs") && html`<${OutputsPanel} key=${axis.name} axis=${axis} />`}
        ${info.registers.length > 0 && html`<${RegistersPanel} axis=${axis} />`}
      </div>
      <div class="column">
        <${NowPanel} axis=${axis} />
        <${ShadowPanel} axis=${axis} />
        ${axis.can("power") && html`<${WhyPanel} axis=${axis} />`}
        <${LimitsPanel} axis=${axis} />
        ${axis.can("set_gains") && html`<${GainsPanel} axis=${axis} />`}
      </div>
    </div>
    <${Jumps} />`;
}

const JUMPS = ["Control", "Jog", "Move", "Home", "Now"];

/** On a phone: to each part of the page from under the thumb. */
function Jumps() {
  const to = (title) => {
    const heading = [...document.querySelectorAll("main h2")].find((each) => each.textContent === title);
    heading?.scrollIntoView({ block: "start" });
  };
  return html`<div class="jumps" role="group" aria-label="Parts of this page">${JUMPS.map(
    (title) => html`<button type="button" onClick=${() => to(title)}>${title}</button>`)}</div>`;
}
