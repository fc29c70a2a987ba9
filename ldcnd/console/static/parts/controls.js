/** Controls: a button says in visible text why it cannot act now; a choice and a tick have labels. */

import { html, useEffect, useId, useLayoutEffect, useRef, useState } from "../html.js";
import { Press } from "../session/api.js";
import { changed } from "../session/rigs.js";
import { clock, sentence } from "./format.js";
import { inPageTerms, pageOf } from "./remedies.js";
import { faultPage } from "./state.js";
import { cameUnderHand } from "./under_hand.js";

/** A button that carries out `act`, shows what came of it, and cannot act while `obstacle` is a text.

 * It stays in the tab order then, so that everybody can reach the reason. A double click and a key that repeats are one
 * press: what is sent may move something, and the button may be another one by the second.
 * With `of` a refusal is about that and goes when it is another: what would be sent, and what the axis does.
 * With `reason` the id of an element that shows the obstacle already. What only `calms` is done by every press, also
 * while the one before has no answer, which may never have got through; all else by none that meets a button which has
 * just come under the hand. A refusal that comes when its page was left stands in `LateRefusals`.
 */
export function Action({ act, of = null, obstacle = null, reason = null, kind = "", calms = false, onDone, onRefused, title, children }) {
  const own = useId();
  const [underWay, setUnderWay] = useState(false);
  const latest = useRef({ waits: false }); // the latest press: a second one comes before the first is drawn
  const isGone = useRef(false);
  useEffect(() => () => {
    isGone.current = true;
  }, []);
  const drawn = useRef();
  drawn.current = { act, obstacle, onDone, onRefused };
  const [refusal, setRefusal] = useState(null);
  useEffect(() => setRefusal(null), [of]);
  const [inVain, setInVain] = useState(null); // why the last press did nothing: the reason may go before it is read
  useEffect(() => {
    const timer = inVain && setTimeout(() => setInVain(null), READ_MS);
    return () => clearTimeout(timer);
  }, [inVain]);

  async function press(event) {
    const came = cameUnderHand(event);
    if ((latest.current.waits && !calms) || event.detail > 1) return;
    const mine = { waits: true };
    latest.current = mine;
    const place = location.hash;
    // what was typed in the same turn, as by a program that types, is drawn behind it: that is what is sent
    if (!calms) await Promise.resolve();
    const now = drawn.current;
    const show = (error) => latest.current === mine && setRefusal(error); // the answer to a later press says more
    const refused = (error) => {
      (now.onRefused ?? show)(error, show);
      if (isGone.current && !(calms && now.onRefused)) noteLate(wordsOf(children), place, error);
    };
    try {
      setInVain(null);
      if (now.obstacle && !calms) return setInVain(sentence(now.obstacle)); // whether it stands already the daemon knows
      if (came && !calms) return refused({ message: came, nearest: null });
      setUnderWay(true);
      setRefusal(null);
      const reply = await now.act();
      now.onDone?.(reply);
    } catch (error) {
      refused(error);
    } finally {
      mine.waits = false;
      if (latest.current === mine) setUnderWay(false);
    }
  }

  const presses = useAtOnce(press);
  return html`<span class="action">
    <button
      type="button" class=${kind} aria-disabled=${obstacle ? "true" : null} aria-busy=${underWay ? "true" : null}
      aria-describedby=${obstacle ? (reason ?? own) : null} title=${title} ...${calms ? presses : { onClick: press }}
      onKeyDown=${(event) => event.repeat && event.key === "Enter" && event.preventDefault()}
    >${children}</button>
    ${obstacle && !reason && html`<small class="reason" id=${own}>${obstacle}</small>`}
    ${inVain && !obstacle && html`<span class="refusal" role="status">Not done: ${inVain}</span>`}
    ${calms && underWay && html`<${NoAnswerYet} what=${wordsOf(children)} />`}
    <${RefusalText} refusal=${refusal} />
  </span>`;
}

/** As long as a person needs to see that a press did nothing, and to read why. */
const READ_MS = 8_000;

/** The visible words on a button. */
function wordsOf(children) {
  return [children].flat().filter((each) => typeof each === "string").join("");
}

/** Every answer of a console, a daemon and drives that are well has come by then; a person who waits goes by what is said. */
const LATE_MS = 350;

/** What is said of a press that takes energy out while its answer is late: it may not even have gone out. */
export function NoAnswerYet({ what }) {
  const [late, setLate] = useState(false);
  useEffect(() => {
    const timer = setTimeout(() => setLate(true), LATE_MS);
    return () => clearTimeout(timer);
  }, []);
  return html`<span class="refusal" role="alert">${late && html`<span class="mark" data-level="bad">${what}: no answer yet, it
    may not have got through. If the machine moves, use the emergency stop.</span>`}</span>`;
}

/** Presses of a button that takes energy out: done when a finger comes down.
 *
 * A browser makes no click of a second finger, such as beside one that holds a jog, nor of a button that has moved away
 * from under the first.
 */
export function useAtOnce(press) {
  const down = useRef(false);
  return {
    onPointerDown: (event) => {
      if (event.button !== 0) return;
      down.current = true;
      press(event);
    },
    onClick: (event) => {
      if (!down.current || event.detail === 0) press(event); // by key, or by what helps a person to press
      down.current = false;
    },
  };
}

/** A place in which one control takes the turn of another: those beside it stay where they are, and keep the focus. */
export function Swap({ children }) {
  return html`<span class="swap">${children}</span>`;
}

const ONCE_MS = 1_000;

/** Keep typed motions from being sent twice by a second Enter or a double click.

 * Returns what says why a motion cannot be sent now, and what sends one unless there is such a reason: it looks again,
 * because the second press comes before the first is drawn. What is to send it is given its `Press`.
 */
export function useOnce() {
  const last = useRef({ text: null, pressed: null });
  const obstacle = (body, moving) => {
    if (!body || last.current.text !== JSON.stringify(body)) return null;
    const { sentMs } = last.current.pressed;
    if (sentMs === null) return "This motion waits for an answer to what was asked before: it is sent within a second, or not at all.";
    if (moving) return "This motion was sent just now: change a value, or wait until the axis stands.";
    const recent = performance.now() - sentMs < ONCE_MS; // a short one may be over before a second press
    return recent ? "This motion was sent less than a second ago: change a value, or wait for a moment." : null;
  };
  const send = (body, moving, act) => {
    const again = obstacle(body, moving);
    if (again) throw new Error(again);
    const mine = { text: JSON.stringify(body), pressed: new Press() };
    last.current = mine;
    return act(mine.pressed).catch((error) => {
      const isOver = error.refused || mine.pressed.sentMs === null; // it was not sent on: it moves nothing
      if (isOver && last.current === mine) last.current = { text: null, pressed: null };
      throw error;
    });
  };
  return { obstacle, send };
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
      html`<b>${refusal.message}</b> ${refusal.remedy && html`<span><${RemedyText} refusal=${refusal} /></span>`}
      ${refusal.code && html` <a href=${faultPage(refusal.code)}>${refusal.code}</a>`}`
    }
  </span>`;
}

const MOST_LATE = 4;
/** What was refused when the page of its button was left already, until the operator has seen it. */
let late = [];

function noteLate(what, at, refusal) {
  late = [...late, { what, at, refusal, atNs: Date.now() * 1e6 }].slice(-MOST_LATE);
  changed();
}

/** What was refused when its page was left: said on every page. */
export function LateRefusals() {
  if (!late.length) return null;
  const dismiss = () => {
    late = [];
    changed();
  };
  return html`<p class="notice mark" data-level="bad">${late.map(({ what, at, refusal, atNs }) => html`<span
    >${clock(atNs).slice(0, -4)} <a href=${at}>${what}</a>: ${sentence(refusal.message)} ${sentence(inPageTerms(refusal))}</span> `)}
    <button type="button" class="plain" onClick=${dismiss}>Dismiss</button></p>`;
}

/** What to do, with a link where that is on the page of an axis. */
function RemedyText({ refusal }) {
  const text = sentence(inPageTerms(refusal));
  const place = pageOf(refusal.axis);
  const [before, ...after] = text.split(place);
  if (!refusal.axis || !refusal.rig || !after.length) return text;
  return html`${before}<a href=${`#/axis/${refusal.rig}/${refusal.axis}`}>${place}</a>${after.join(place)}`;
}

/** Enter in a field does what the main button of its panel does. */
export function enterSends(event) {
  if (event.key !== "Enter" || event.target.tagName !== "INPUT" || event.isComposing) return;
  event.preventDefault();
  if (event.repeat) return;
  event.currentTarget.closest(".panel").querySelector("button.main").click();
}

/** Keys that open a list, in one browser or the other. */
const OPENS = [" ", "Enter", "ArrowDown", "ArrowUp", "F4"];
const MOST_LISTED = 12;

/** A labelled choice; `options` are pairs of value and text.

 * It shows what `value` is: one that is not among the options, or not any more, stands there as `missing`. While the list
 * has the focus, and so may be open, its options stay as they are.
 *
 * The page opens the list itself, in its place: one that the browser opens keeps Escape to itself, and nothing would stop.
 * A finger opens that of the browser, without which a phone shows none.
 */
export function Choice({ label, options, value, onChange, hint, missing }) {
  const id = useId();
  const list = useRef();
  const shown = useRef(options);
  const by = useRef({ finger: false, opened: false });
  const [open, setOpen] = useState(false);
  if (document.activeElement !== list.current || !list.current) shown.current = options;
  const wanted = `${value ?? ""}`;
  const known = shown.current.some(([each]) => `${each}` === wanted);
  const [, redraw] = useState(0);
  useLayoutEffect(() => {
    list.current.value = wanted;
  }, [wanted, shown.current]);
  useLayoutEffect(() => {
    if (open) list.current.scrollIntoView({ block: "nearest" });
  }, [open]);

  function show() {
    list.current.parentElement.style.height = `${list.current.offsetHeight}px`; // what is below stays where it is
    list.current.focus();
    setOpen(true);
  }
  function close(taken) {
    if (!open) return;
    list.current.parentElement.style.height = "";
    setOpen(false);
    if (taken && list.current.value !== wanted) onChange(list.current.value);
    else list.current.value = wanted;
  }
  const pressed = (event) => {
    const { key, altKey } = event;
    if (!open && OPENS.includes(key)) show();
    else if (open && (key === "Enter" || key === " " || key === "F4" || (altKey && key === "ArrowUp"))) close(true);
    else {
      if (key === "Tab") close(true);
      if (key === "Escape") close(false);
      return;
    }
    event.preventDefault();
  };
  return html`<div class="field">
    <label for=${id}>${label}</label>
    <span class="choice" data-open=${open ? "yes" : "no"}><select id=${id} ref=${list} autocomplete="off" aria-describedby=${hint ? `${id}-hint` : null}
      size=${open ? Math.max(2, Math.min(MOST_LISTED, shown.current.length + (known ? 0 : 1))) : 0}
      onChange=${(event) => !open && onChange(event.target.value)} onKeyDown=${pressed}
      onPointerDown=${(event) => {
        by.current = { finger: event.pointerType === "touch", opened: false };
      }}
      onMouseDown=${(event) => {
        if (open || event.button !== 0 || by.current.finger) return;
        event.preventDefault();
        by.current.opened = true;
        show();
      }}
      onClick=${(event) => event.target.tagName === "OPTION" && !by.current.opened && close(true)}
      onBlur=${() => {
        close(false);
        redraw((count) => count + 1);
      }}>
      ${!known && html`<option key=" missing" value=${wanted} disabled>${missing ?? (wanted ? `${wanted}: not there any more` : "")}</option>`}
      ${shown.current.map(([each, text]) => html`<option key=${each} value=${each}>${text}</option>`)}
    </select></span>
    ${hint && html`<small id=${`${id}-hint`}>${hint}</small>`}
  </div>`;
}

/** A labelled tick; it shows `checked` also where a click has not changed that. */
export function Tick({ label, checked, onChange }) {
  const id = useId();
  const box = useRef();
  useLayoutEffect(() => {
    box.current.checked = checked;
  });
  return html`<div class="tick">
    <input id=${id} ref=${box} type="checkbox" autocomplete="off" onChange=${(event) => onChange(event.target.checked)} />
    <label for=${id}>${label}</label>
  </div>`;
}

/** A part of a page with a heading of its own.
 *
 * With `of` it has values of that rig; while nothing comes from there, it says that they are the last known ones.
 */
/** A part of a page. `of` is the rig of its values; `old` says why they may not hold any more, of a rig that is there. */
export function Panel({ title, note, of, old = null, children, ...more }) {
  const id = useId();
  const stale = of && { "data-stale": of.worth || old ? "yes" : "no" };
  return html`<section class="panel" aria-labelledby=${id} ...${stale} ...${more}>
    <header><h2 id=${id}>${title}</h2>${note && html`<p class="quiet">${note}</p>`}
      ${of?.worth && html`<p class="mark" data-level="bad">last known values</p>`}
      ${!of?.worth && old && html`<p class="mark" data-level="warn">old values: ${old}</p>`}</header>
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
