/** Controls: a button says in visible text why it cannot act now; a field has a label, a unit and a hint. */

import { html, useId, useState } from "../html.js";
import { inPageTerms } from "./remedies.js";
import { faultPage } from "./state.js";

/** A button that carries out `act`, shows what came of it, and cannot act while `obstacle` is a text.

 * It stays in the tab order then, so that everybody can reach the reason.
 * With `reason` the id of an element that shows the obstacle already.
 */
export function Action({ act, obstacle = null, reason = null, kind = "", onDone, onRefused, title, children }) {
  const own = useId();
  const [underWay, setUnderWay] = useState(false);
  const [refusal, setRefusal] = useState(null);

  async function press() {
    if (obstacle || underWay) return;
    setUnderWay(true);
    setRefusal(null);
    try {
      const outcome = await act();
      onDone?.(outcome);
    } catch (error) {
      if (onRefused) onRefused(error);
      else setRefusal(error);
    } finally {
      setUnderWay(false);
    }
  }

  return html`<span class="action">
    <button
      type="button" class=${kind} aria-disabled=${obstacle ? "true" : null} aria-busy=${underWay ? "true" : null}
      aria-describedby=${obstacle ? (reason ?? own) : null} title=${title} onClick=${press}
    >${children}</button>
    ${obstacle && !reason && html`<small class="reason" id=${own}>${obstacle}</small>`}
    <${RefusalText} refusal=${refusal} />
  </span>`;
}

/** The one line under a group of controls that says why they cannot act. */
export function Reason({ id, text }) {
  return html`<p class="reason" id=${id}>${text ?? ""}</p>`;
}

/** What was refused, why, and what to do. */
export function RefusalText({ refusal }) {
  return html`<span class="refusal" role="alert">
    ${
      refusal &&
      html`<b>${refusal.message}</b> ${refusal.remedy && html`<span>${inPageTerms(refusal)}.</span>`}
      ${refusal.code && html` <a href=${faultPage(refusal.code)}>${refusal.code}</a>`}`
    }
  </span>`;
}

/** A labelled input; an empty one is null, a number is a number. */
export function Field({ label, unit, hint, value, onChange, type = "number", ...more }) {
  const id = useId();
  const told = `${id}-hint`;
  const read = (text) => (text === "" ? null : type === "number" ? Number(text) : text);
  return html`<div class="field">
    <label for=${id}>${label}${unit && html` <span class="unit">${unit}</span>`}</label>
    <input
      id=${id} type=${type} step=${type === "number" ? "any" : null} value=${value ?? ""} autocomplete="off"
      aria-describedby=${hint ? told : null} onInput=${(event) => onChange(read(event.target.value))} ...${more}
    />
    ${hint && html`<small id=${told}>${hint}</small>`}
  </div>`;
}

/** Enter in a field does what the main button of its panel does. */
export function enterSends(event) {
  if (event.key !== "Enter" || event.target.tagName !== "INPUT") return;
  event.preventDefault();
  event.currentTarget.closest(".panel").querySelector("button.main").click();
}

/** A labelled choice; `options` are pairs of value and text. */
export function Choice({ label, options, value, onChange, hint }) {
  const id = useId();
  return html`<div class="field">
    <label for=${id}>${label}</label>
    <select id=${id} aria-describedby=${hint ? `${id}-hint` : null} onChange=${(event) => onChange(event.target.value)}>
      ${options.map(([each, text]) => html`<option value=${each} selected=${each === (value ?? "")}>${text}</option>`)}
    </select>
    ${hint && html`<small id=${`${id}-hint`}>${hint}</small>`}
  </div>`;
}

/** A labelled tick. */
export function Tick({ label, checked, onChange }) {
  const id = useId();
  return html`<div class="tick">
    <input id=${id} type="checkbox" checked=${checked} onChange=${(event) => onChange(event.target.checked)} />
    <label for=${id}>${label}</label>
  </div>`;
}

/** A part of a page with a heading of its own. */
export function Panel({ title, note, children, ...more }) {
  const id = useId();
  return html`<section class="panel" aria-labelledby=${id} ...${more}>
    <header><h2 id=${id}>${title}</h2>${note && html`<p class="quiet">${note}</p>`}</header>
    ${children}
  </section>`;
}

/** Pairs of term and value. */
export function Facts({ of }) {
  return html`<dl class="facts">
    ${of.map(([term, value]) => html`<div><dt>${term}</dt><dd>${value ?? "–"}</dd></div>`)}
  </dl>`;
}

/** A table that scrolls sideways by itself when there is no room, also by keyboard.

 * The title of a column of numbers begins with "#": it stands on their side.
 */
export function Table({ label, head, rows, kind = "" }) {
  return html`<div class="scrolls" tabindex="0" role="region" aria-label=${label}>
    <table class=${kind}>
      <thead><tr>${head.map((each) => html`<th scope="col" class=${each[0] === "#" ? "number" : null}>${each.replace("#", "")}</th>`)}</tr></thead>
      <tbody>${rows}</tbody>
    </table>
  </div>`;
}
