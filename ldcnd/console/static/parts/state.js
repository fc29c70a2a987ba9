/** State, quality and the like: always a word with a shape, and colour only where something deserves a look. */

import { html } from "../html.js";
import { age, number } from "./format.js";

const LEVELS = {
  disabled: "off",
  standstill: "still",
  homing: "moving",
  discrete_motion: "moving",
  continuous_motion: "moving",
  stopping: "moving",
  error_stop: "bad",
};

/** The state of an axis. */
export function StateWord({ axis }) {
  const { live, state } = axis.condition;
  return html`<span class="state" data-level=${live ? (LEVELS[axis.state?.state] ?? "unknown") : "unknown"}>${state}</span>`;
}

/** A position of an axis, or one that it goes to: in brackets where its numbers do not say where it is. */
export function placed(axis, position, decimals) {
  const value = number(position, decimals);
  return position == null || axis.condition.known ? value : `(${value})`;
}

/** The position of an axis as text: with its mark where it does not say where the axis is. */
export function placeText(axis, decimals) {
  const { known, mark } = axis.condition;
  const value = placed(axis, axis.samples.position?.value, decimals);
  return known ? value : `${value} ${mark}`;
}

/** The same without the mark, which `Homed` has. */
export function Place({ axis, decimals, label = null }) {
  return html`<span class="place" data-known=${axis.condition.known ? "yes" : "no"}><b aria-label=${label}
    >${placed(axis, axis.samples.position?.value, decimals)}</b> <span class="unit">${axis.info.unit}</span></span>`;
}

/** Whether the position says where the axis is: the mark where it does not. */
export function Homed({ axis }) {
  const { known, mark, live } = axis.condition;
  if (!known) return html`<span class="mark unhomed" data-level=${live ? "warn" : "bad"}>${mark}</span>`;
  return html`<span class="quiet">${axis.state?.has_reference === false ? "–" : "homed"}</span>`;
}

/** What is to be said of an axis besides its state and its mark, in a few words each. */
export function TroubleWords({ axis }) {
  const { mark, state, troubles } = axis.condition;
  const said = troubles.filter(({ short }) => short !== mark && short !== state);
  return said.map(({ level, short }) => html` <${Mark} level=${level}>${short}<//>`);
}

/** How much the values are worth and how old they are. */
export function QualityWord({ axis }) {
  const { word, level } = axis.quality;
  return html`<span class="quality" data-level=${level}>${word}</span>${" "}
    <span class="quiet">${age(axis.ageS(axis.samples.position ? "position" : "state"))}</span>`;
}

/** A word that stands out only when its level says so: "", "warn" or "bad". */
export function Mark({ level = "", children }) {
  return html`<span class="mark" data-level=${level}>${children}</span>`;
}

/** A yes or no of the axis, as a lamp with its word. */
export function Lamp({ label, on, level = "", yes = "yes", no = "no", unknown = "unknown" }) {
  const known = on !== null && on !== undefined;
  return html`<li class="lamp" data-on=${known && on ? "yes" : "no"} data-level=${known && on ? level : ""}>
    <span>${label}</span> <b>${known ? (on ? yes : no) : unknown}</b>
  </li>`;
}

/** A share of a whole as a bar with its number. */
export function Meter({ label, share, text, level = "" }) {
  return html`<span class="meter" data-level=${level}>
    <span class="quiet">${label}</span>
    <meter min="0" max="1" value=${Math.min(1, share ?? 0)} aria-label=${label}>${text}</meter>
    <b>${text}</b>
  </span>`;
}

/** The page about a fault or an error code. */
export function faultPage(code) {
  return `/faults/${encodeURIComponent(code)}`;
}
