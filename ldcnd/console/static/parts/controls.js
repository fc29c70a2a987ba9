/** Controls: a button says in visible text why it cannot act now; a choice and a tick have labels. */

import { html, useId, useRef, useState } from "../html.js";
import { inPageTerms } from "./remedies.js";
import { faultPage } from "./state.js";

/** A button that carries out `act`, shows what came of it, and cannot act while `obstacle` is a text.

 * It stays in the tab order then, so that everybody can reach the reason.
 * With `reason` the id of an element that shows the obstacle already. `outcome` says what a reply means.
 */
export function Action({ act, obstacle = null, reason = null, kind = "", onDone, onRefused, title, outcome, children }) {
  const own = useId();
  const [underWay, setUnderWay] = useState(false);
  const pressed = useRef(false); // a second press comes before the first is drawn
  const [refusal, setRefusal] = useState(null);
  const [said, setSaid] = useState("");

  async function press() {
    if (obstacle || pressed.current) return;
    pressed.current = true;
    setUnderWay(true);
    setRefusal(null);
    setSaid("");
    try {
      const reply = await act();
      onDone?.(reply);
      if (outcome) setSaid(outcome(reply));
    } catch (error) {
      if (onRefused) onRefused(error);
      else setRefusal(error);
    } finally {
      pressed.current = false;
      setUnderWay(false);
    }
  }

  return html`<span class="action">
    <button
      type="button" class=${kind} aria-disabled=${obstacle ? "true" : null} aria-busy=${underWay ? "true" : null}
      aria-describedby=${obstacle ? (reason ?? own) : null} title=${title} onClick=${press}
    >${children}</button>
    ${obstacle && !reason && html`<small class="reason" id=${own}>${obstacle}</small>`}
    ${outcome && html`<small role="status">${said}</small>`}
    <${RefusalText} refusal=${refusal} />
  </span>`;
}

const ONCE_MS = 1_000;

/** Keep typed motions from being sent twice by a second Enter or a double click.

 * Returns what notes a motion that is sent, and what returns why the same one cannot be sent now.
 */
export function useOnce() {
  const last = useRef({ text: null, atMs: 0 });
  return {
    note: (body) => {
      last.current = { text: JSON.stringify(body), atMs: performance.now() };
    },
    obstacle: (body, moving) => {
      if (!body || last.current.text !== JSON.stringify(body)) return null;
      const recent = performance.now() - last.current.atMs < ONCE_MS;
      return recent || moving ? "This motion was sent just now: change a value, or wait until the axis stands." : null;
    },
  };
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

/** Enter in a field does what the main button of its panel does. */
export function enterSends(event) {
  if (event.key !== "Enter" || event.target.tagName !== "INPUT" || event.isComposing) return;
  event.preventDefault();
  if (event.repeat) return;
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
