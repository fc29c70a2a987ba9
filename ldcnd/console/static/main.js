/** The frame round every page: where one is, what is wrong, the stop; and the routes. */

import { html, render, useEffect, useErrorBoundary, useLayoutEffect, useRef, useState } from "./html.js";
import { AxisPage } from "./pages/axis.js";
import { CommissioningPage } from "./pages/commissioning.js";
import { EventsPage } from "./pages/events.js";
import { NetworkPage } from "./pages/network.js";
import { ParametersPage } from "./pages/parameters.js";
import { RigPage } from "./pages/rig.js";
import { ScopePage } from "./pages/scope.js";
import { TracePage } from "./pages/trace.js";
import { TuningPage } from "./pages/tuning.js";
import { LateRefusals } from "./parts/controls.js";
import { number, sentence } from "./parts/format.js";
import { problems } from "./parts/problems.js";
import { Mark } from "./parts/state.js";
import { AxisStrip, PlaceAndTarget } from "./parts/strip.js";
import { overrideOf, slowed } from "./pages/rig_speed.js";
import { StopAll, StopReport, Stops } from "./parts/stop_all.js";
import { controlled, dismissLost, keepControl, lost, lostInWords } from "./session/control.js";
import { loginIsGone } from "./session/api.js";
import { feed } from "./session/feed.js";
import { axesOf, axisNamed, changed, commissions, failure, isWhole, namesOf, rigs, titleOf, useRigs, watch } from "./session/rigs.js";

const PAGES = [
  ["rig", "Rig", RigPage],
  ["scope", "Scope", ScopePage],
  ["trace", "Trace", TracePage],
  ["tuning", "Tuning", TuningPage],
  ["parameters", "Parameters", ParametersPage],
  ["network", "Network", NetworkPage],
  ["events", "Events", EventsPage],
  ["commissioning", "Commissioning", CommissioningPage],
];

/** The parts of the address behind the hash: page, rig, axis or line, and an instant. */
function place() {
  const [page = "rig", ...rest] = location.hash.slice(2).split("/").map(decodeURIComponent);
  return { page: page || "rig", rig: rest[0] ?? null, axis: rest[1] ?? null, instant: Number(rest[2]) || null };
}

function Navigation({ at }) {
  return html`<nav aria-label="Pages">
    ${PAGES.filter(([page]) => commissions || page !== "commissioning").map(([page, title]) => html`<a
      href=${`#/${page}`} aria-current=${at.page === page ? "page" : null}>${title}</a>`)}
  </nav>`;
}

/** Return what is said where nothing is wrong or moves, as far as this page knows. */
function calm(text) {
  if (!isWhole()) return "Waiting for values";
  return rigs.size ? text : "No rig is known";
}

/** One line on how things are: heard by screen readers when it changes. */
function Summary() {
  const wrong = problems(rigs.values());
  const worst = wrong.some((each) => each.level === "bad") ? "bad" : wrong.length ? "warn" : "";
  const mine = controlled();
  return html`<p class="summary" role="status">
    ${feed.live ? "" : html`<${Mark} level="bad">No data from the console process<//> `}
    <${Mark} level=${worst}>
      ${wrong.length ? `${wrong.length} need${wrong.length === 1 ? "s" : ""} attention` : calm("Nothing needs attention")}<//>
    ${[...rigs.values()].filter((rig) => !rig.worth && slowed(rig)).map((rig) => html`<${Mark} level="warn"
      >${rigs.size > 1 ? `${rig.name}: ` : ""}speed override ${number(overrideOf(rig), 0)} %${overrideOf(rig) === 0 ? ": no command moves anything" : ""}<//> `)}
    ${[...rigs.values()].filter((rig) => rig.runs).map(({ run }) => html` <a href="#/rig"><${Mark} level="warn"
      >${run.kind} ${run.name} ${run.waits ? "is paused" : "runs"}<//></a> `)}
    ${mine.length > 0 && html` <span class="mine">You control ${namesOf(mine)}</span>`}
  </p>`;
}

const MOST_MOVING = 6;

/** What moves, where, and what is wrong, in sight wherever a page is scrolled to; the axis of its page with its ends. */
function Strip({ at }) {
  const axis = at.page === "axis" && axisNamed(at);
  if (axis) return html`<${AxisStrip} key=${`${axis.rig.name} ${axis.name}`} axis=${axis} />`;
  const known = axesOf().filter((each) => each.info);
  const moving = known.filter((each) => each.condition.live && each.state?.moving === "yes");
  const unsure = known.filter((each) => !each.condition.live || each.state?.moving === "unknown");
  const [worst] = problems(rigs.values());
  return html`<div class="strip">
    <span class="moving">${moving.length
      ? moving.slice(0, MOST_MOVING).map((each) => html`<a href=${`#/axis/${each.rig.name}/${each.name}`}>${titleOf(each)}</a> <${PlaceAndTarget} axis=${each} /> `)
      : !unsure.length && html`<span class="quiet">${calm("Nothing moves")}</span>`}${moving.length > MOST_MOVING && ` and ${moving.length - MOST_MOVING} more move`}${
      unsure.length > 0 && html` <span class="mark" data-level="bad">may move: ${namesOf(unsure.slice(0, MOST_MOVING))}${
        unsure.length > MOST_MOVING && ` and ${unsure.length - MOST_MOVING} more`}</span>`}</span>
    ${worst && html`<span class="worst mark" data-level=${worst.level}>${worst.places[0].where}${worst.places.length > 1 ? ` and ${worst.places.length - 1} more` : ""}: ${worst.text}</span>`}
  </div>`;
}

function Notices() {
  return html`<div class="notices" role="alert">
    ${loginIsGone() && html`<p class="notice mark" data-level="bad">The login of this page is gone: its cookies were cleared or
      replaced. Halt and stop work on. For all else load the page again, or open it with a new link of ldcnd console.</p>`}
    ${failure && html`<p class="notice mark" data-level="bad">${sentence(failure.message)} ${sentence(failure.remedy ?? "")}</p>`}
    ${[...rigs.values()].filter((rig) => rig.worth).map((rig) => html`<p class="notice mark" key=${rig.name} data-level="bad"
      >${rig.name}: no new values. ${rig.worth.why}</p>`)}
    ${lost.size > 0 && html`<p class="notice mark" data-level="bad">${lostInWords().join(" ")}
      <button type="button" class="plain" onClick=${dismissLost}>Dismiss</button></p>`}
    <${LateRefusals} />
    <${OtherUnits} />
    <${Stops} />
  </div>`;
}

/** Which axes are in another unit than before. */
function OtherUnits() {
  const axes = axesOf().filter(({ info, unitChange }) => info && unitChange?.seen === false);
  if (!axes.length) return null;
  const dismiss = () => {
    for (const { unitChange } of axes) unitChange.seen = true;
    changed();
  };
  return html`<p class="notice mark" data-level="warn">The daemon has other units than before: ${axes
    .map(({ name, info, unitChange: { from } }) => (from === info.unit ? name : `${name} in ${info.unit}, was in ${from}`)).join("; ")}. What was typed for ${axes.length > 1 ? "them" : "it"} is
    cleared. <button type="button" class="plain" onClick=${dismiss}>Dismiss</button></p>`;
}

/** A page that fails must not take the stop away. */
function Guarded({ children }) {
  const [error] = useErrorBoundary((failed) => console.error(failed));
  if (!error) return children;
  return html`<p class="notice mark" data-level="bad">This page has failed: ${error.message}. The stop still works; load the page again.</p>`;
}

function Console() {
  const [at, setAt] = useState(place());
  const main = useRef();
  useRigs();
  useLayoutEffect(() => { // an address that is changed before the page is painted counts, too
    const moved = () => {
      setAt(place());
      main.current.focus();
      scrollTo(0, 0);
    };
    addEventListener("hashchange", moved);
    return () => removeEventListener("hashchange", moved);
  }, []);
  const frame = useRef();
  useEffect(() => {
    // whatever notices the frame holds: what gets the focus comes to lie below it
    const watching = new ResizeObserver(() => {
      document.documentElement.style.scrollPaddingTop = `${frame.current.offsetHeight + 8}px`;
    });
    watching.observe(frame.current);
    return () => watching.disconnect();
  }, []);
  const [, title, Page] = PAGES.find(([page]) => page === at.page) ?? ["axis", at.axis ?? "Axis", AxisPage];
  useEffect(() => {
    const place = at.page === "axis" ? `Axis ${titleOf({ rig: { name: at.rig }, name: at.axis })}` : title;
    document.title = `${lost.size ? "Control lost – " : ""}${place} – ldcnd`;
  }, [at.page, at.rig, at.axis, lost.size, rigs.size]);

  return html`<a class="skip" href="#main" onClick=${(event) => {
    event.preventDefault();
    main.current.focus();
  }}>Skip to the page</a>
    <header class="frame" ref=${frame}>
      <div class="top">
        <span class="brand">ldcnd</span>
        <${Navigation} at=${at} />
        <${Summary} />
        <${StopAll} />
      </div>
      <${Strip} at=${at} />
      <${Notices} />
      <${StopReport} />
    </header>
    <main id="main" tabindex="-1" ref=${main}>
      <${Guarded} key=${`${JSON.stringify(at)} ${rigs.get(at.rig)?.axes.get(at.axis)?.unitChanges ?? 0}`}><${Page} at=${at} /><//>
    </main>`;
}

/** A text, link or file that is dropped changes no field and opens no page: a hand that slips must move nothing. */
for (const kind of ["dragover", "drop"]) {
  addEventListener(kind, (event) => {
    if (event.target.type !== "file") event.preventDefault();
  });
}

// a browser that came by a link on another site has asked twice: `again.js`
if (location.search) history.replaceState(null, "", `${location.pathname}${location.hash}`);

watch();
keepControl();
render(html`<${Console} />`, document.getElementById("console"));
