/** Fields that people type into: the text in a field belongs to the person, and only what it means goes to the page. */

import { html, useId, useLayoutEffect, useRef, useState } from "../html.js";
import { range, readNumber, Unread } from "./number_text.js";

/** A labelled field for a number.
 *
 * `value` is what the page holds: a number, null for none, or the `Unread` that this field has reported. `onChange` gets
 * the same. With the `units` of an axis it is the number that is sent, whatever unit is typed. `meaning` says what the number will do, from its text with unit. Nothing writes into the field while it has
 * the focus: what the page has changed meanwhile is shown when the focus leaves.
 */
export function NumberField({ label, units, unit = units?.[0].unit.replace("/s2", "/s²") ?? "", hint, value, onChange, meaning = (text) => text, whole, min, max, plain }) {
  const id = useId();
  const [reading, setReading] = useState(value ?? null);
  const read = (text) => readNumber(text, { unit, units, whole, min, max });
  const write = (held) => textOf(typeof held === "number" && units ? Number(units[0].to(held).toPrecision(15)) : held);
  const input = useText(value ?? null, write, (text) => {
    const now = read(text);
    setReading(now);
    onChange(now);
    return now;
  }, setReading);
  const refused = reading instanceof Unread;
  const shown = refused || reading === null ? "" : meaning(units ? inUnits(reading, units[0]) : `${reading}${unit && ` ${unit}`}`);
  const wanted = min === undefined && max === undefined ? "" : `${range(min ?? -Infinity, max ?? Infinity)} ${unit}`;
  const about = `${id}-about`;
  return html`<div class="field">
    ${plain ? null : html`<label for=${id}>${label}${unit && html` <span class="unit">${unit}</span>`}</label>`}
    <input id=${id} ref=${input} type="text" inputmode="decimal" autocomplete="off" spellcheck=${false}
      aria-label=${plain ? label : null} aria-invalid=${refused ? "true" : null} aria-describedby=${about} />
    <small id=${about}>${refused
      ? html`<span class="unread">${reading.message}</span>`
      : html`<span class="read">${shown}</span> ${hint ?? (whole || plain ? wanted : "")}`}</small>
  </div>`;
}

/** Return a number as it is shown and, where that is another one, as it is sent. */
function inUnits(value, { unit, sent, to }) {
  const [shown, network] = [to(value), value].map((each) => Number(each.toPrecision(9)));
  return `${shown} ${unit.replace("/s2", "/s²")}${unit === sent ? "" : ` = ${network} ${sent}`}`;
}

/** A labelled field for a text; an empty one is null. */
export function TextField({ label, hint, value, onChange, type = "text", maxlength, invalid = false }) {
  const id = useId();
  const input = useText(value ?? null, (text) => text ?? "", (text) => {
    onChange(text === "" ? null : text);
    return text === "" ? null : text;
  });
  return html`<div class="field">
    <label for=${id}>${label}</label>
    <input id=${id} ref=${input} type=${type} aria-invalid=${invalid ? "true" : null} maxlength=${maxlength} autocomplete="off"
      aria-describedby=${hint ? `${id}-hint` : null} />
    ${hint && html`<small id=${`${id}-hint`}>${hint}</small>`}
  </div>`;
}

/** Return why one of these values cannot be sent, by its label; null when all can. */
export function unread(values) {
  for (const [label, value] of Object.entries(values)) if (value instanceof Unread) return `${label}: ${value.message}.`;
  return null;
}

/** Return the ref of an input whose text no redraw touches.
 *
 * `read` is called with each text that is complete: not while an input method composes one. What it returns is compared
 * with `value`: another one has come from the page, and is shown as `write` has it as soon as the field has no focus.
 */
function useText(value, write, read, onShown = () => {}) {
  const input = useRef();
  const state = useRef({ reported: undefined });
  const now = useRef();
  now.current = { value, write, read, onShown };

  function show() {
    const { value: wanted } = now.current;
    if (Object.is(state.current.reported, wanted) || document.activeElement === input.current) return;
    state.current.reported = wanted;
    input.current.value = now.current.write(wanted);
    now.current.onShown(wanted);
  }

  useLayoutEffect(show);
  useLayoutEffect(() => {
    const field = input.current;
    const typed = (event) => {
      if (!event.isComposing) state.current.reported = now.current.read(field.value);
    };
    const heard = ["input", "compositionend"];
    for (const each of heard) field.addEventListener(each, typed);
    field.addEventListener("blur", show);
    return () => {
      for (const each of heard) field.removeEventListener(each, typed);
      field.removeEventListener("blur", show);
    };
  }, []);
  return input;
}

function textOf(value) {
  return value instanceof Unread ? value.text : String(value ?? "");
}
