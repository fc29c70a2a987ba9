/** Motions of an axis, each previewed by the daemon before it is commanded. */

import { html, useId, useLayoutEffect, useState } from "../html.js";
import { Action, Choice, enterSends, Panel, Reason, RefusalText, useOnce } from "../parts/controls.js";
import { decimalsOf, duration, number } from "../parts/format.js";
import { StoryOf } from "../parts/motion_story.js";
import { NumberField, unread } from "../parts/number_field.js";
import { shownQuantity, unitsOf } from "../parts/number_text.js";
import { command, controls, question, questionWaitsFor } from "../session/control.js";
import { moves, obstacle } from "../session/obstacles.js";

const PAUSE_MS = 250;
/** Registers are whole numbers; so large a share of a value is worth a word. */
const NOTICED = 1e-4;
const KINDS = {
  move_absolute: {
    title: "to a position",
    field: "position",
    label: "Position",
    dimension: "position",
    meaning: (axis, text) => `moves ${axis} to ${text}`,
    previewed: true,
  },
  move_relative: {
    title: "by a distance",
    field: "distance",
    label: "Distance",
    dimension: "position",
    meaning: (axis, text) => `moves ${axis} by ${text}`,
    previewed: true,
  },
  move_velocity: {
    title: "at a velocity",
    field: "velocity",
    label: "Velocity",
    dimension: "velocity",
    meaning: (axis, text) => `runs ${axis} at ${text}`,
    previewed: true,
  },
  set_pwm: { title: "with a raw duty", field: "duty", label: "Duty, −1 to 1", previewed: false, min: -1, max: 1 },
  move_analog: {
    title: "to a sensor value",
    field: "target",
    label: "Target",
    unit: "A/D count",
    previewed: false,
  },
  probe: {
    title: "until an input, and latch",
    field: "distance",
    label: "Distance at most",
    dimension: "position",
    previewed: false,
  },
};
const SOURCES = [
  ["forward_limit", "the forward limit switch changes"],
  ["reverse_limit", "the reverse limit switch changes"],
  ["index", "the index comes"],
];
const BUFFERING = [
  ["refuse", "refuse it"],
  ["aborting", "halt, then move"],
  ["buffered", "wait for its end"],
];

/** The panel, of an axis that takes any of these motions. */
export function MovePanel({ axis }) {
  const kinds = Object.keys(KINDS).filter((verb) => axis.can(verb));
  return kinds.length > 0 && html`<${Move} axis=${axis} kinds=${kinds} />`;
}

function Move({ axis, kinds }) {
  const [verb, setVerb] = useState(kinds[0]);
  const [values, setValues] = useState({});
  const reason = useId();
  const { field, label, unit, dimension, previewed, meaning, min, max } = KINDS[verb];
  const once = useOnce();
  const set = (name) => (value) => setValues((last) => ({ ...last, [name]: value }));
  const body = bodyOf(verb, values);
  const missing = unread(usedBy(verb, values)) ?? (body === null ? `${missingOf(verb, values)} is missing.` : null);
  const way = obstacle(axis, verb, body?.buffer_mode !== undefined && body.buffer_mode !== "refuse") ?? missing ?? once.obstacle(body, moves(axis));
  const move = () => once.send(body, moves(axis), (pressed) => command(axis, verb, body, undefined, pressed));
  const [sent, setSent] = useState(null);
  const noteSent = (reply) => setSent({ ...reply, run: axis.rig.daemon?.instance, atMs: performance.now() });

  return html`<${Panel} title="Move">
    <div class="fields" onKeyDown=${enterSends}>
      <${Choice} label="Move" options=${kinds.map((each) => [each, KINDS[each].title])} value=${verb}
        onChange=${setVerb} />
      <${NumberField} key=${verb} label=${label} unit=${unit} units=${dimension && unitsOf(axis.info, dimension)} value=${values[field]} onChange=${set(field)}
        min=${min} max=${max} meaning=${meaning && ((text) => meaning(axis.name, text))} />
      ${
        verb === "set_pwm"
          ? html`<${NumberField} key="for" label="For" unit="s" value=${values.duration_s} onChange=${set("duration_s")} />`
          : html`${
              verb !== "move_velocity" &&
              html`<${NumberField} key="speed" label="Velocity" units=${unitsOf(axis.info, "velocity")} value=${values.speed}
              onChange=${set("speed")} hint="empty: the axis default" />`
            }
            <${NumberField} key="acceleration" label="Acceleration" units=${unitsOf(axis.info, "acceleration")} value=${values.acceleration}
              onChange=${set("acceleration")} hint="empty: the axis default" />`
      }
      ${
        verb === "probe" &&
        html`<${Choice} label="Until" options=${SOURCES} value=${values.source ?? "forward_limit"}
          onChange=${set("source")} />`
      }
      ${
        verb === "move_analog" &&
        html`<${NumberField} key="timeout" label="For at most" unit="s" value=${values.timeout_s} onChange=${set("timeout_s")}
            hint="empty: as configured" />
          <${NumberField} key="reach" label="Distance at most" units=${unitsOf(axis.info, "position")} value=${values.reach} onChange=${set("reach")}
            hint="empty: as configured" />`
      }
      ${previewed && html`<${Choice} label="If it moves already" options=${verb === "move_velocity" ? [["refuse", "refuse it, unless it moves at a velocity"], ...BUFFERING.slice(1)] : BUFFERING}
        value=${values.buffer_mode ?? "refuse"} onChange=${set("buffer_mode")} />`}
    </div>
    ${previewed && html`<${Preview} axis=${axis} body=${body} field=${field} onNearest=${set(field)} />`}
    <p class="row"><${Action} act=${move} of=${[verb, JSON.stringify(body), axis.state?.state].join()} obstacle=${way} reason=${reason}
      kind="main" onDone=${noteSent}>Move<//>
      <span class="story" role="status">${sent && html`<${StoryOf} axis=${axis} sent=${sent} />`}</span></p>
    ${way && html`<${Reason} id=${reason} text=${way} />`}
  <//>`;
}

/** Return the label of the field that a verb misses. */
function missingOf(verb, values) {
  const { field, label } = KINDS[verb];
  return values[field] === null || values[field] === undefined ? label : "For";
}

/** Return the values that a verb would send, by what their fields are called. */
function usedBy(verb, values) {
  const { field, label } = KINDS[verb];
  const main = { [label]: values[field] };
  if (verb === "set_pwm") return { ...main, For: values.duration_s };
  const limits = { ...(verb !== "move_velocity" && { Velocity: values.speed }), Acceleration: values.acceleration };
  const ends = verb === "move_analog" && { "For at most": values.timeout_s, "Distance at most": values.reach };
  return { ...main, ...limits, ...ends };
}

/** Return what the verb carries, or null while a value is missing or cannot be read. */
function bodyOf(verb, values) {
  const { field } = KINDS[verb];
  if (unread(usedBy(verb, values))) return null;
  if (values[field] === null || values[field] === undefined) return null;
  if (verb === "set_pwm") return values.duration_s ? { duty: values.duty, duration_s: values.duration_s } : null;
  const body = { [field]: values[field], acceleration: values.acceleration ?? null };
  if (verb !== "move_velocity") body.velocity = values.speed ?? null;
  if (verb === "probe") return { ...body, sources: [values.source ?? "forward_limit"] };
  if (verb === "move_analog") return { ...body, timeout_s: values.timeout_s ?? null, distance: values.reach ?? null };
  body.buffer_mode = values.buffer_mode ?? "refuse";
  return body;
}

function Preview({ axis, body, field, onNearest }) {
  const [plan, setPlan] = useState(null);
  const [refusal, setRefusal] = useState(null);
  const asked = body && !axis.rig.worth && JSON.stringify({ ...body, buffer_mode: undefined });
  const { state } = axis;
  // what a motion would do depends on where the axis is, which a motion or a stop has changed, and on how fast it may be
  const situation = JSON.stringify([state?.state, state?.command?.command_id, state?.referenced, state?.stop_latched,
    state?.enabled, state?.link, state?.speed_override, axis.holder, controls(axis)]);
  useLayoutEffect(() => { // what it said of another text is never shown beside this one
    setPlan(null);
    setRefusal(null);
    if (!asked) return undefined;
    let wanted = true;
    const timer = setTimeout(() => {
      question(axis, "preview", JSON.parse(asked)).then(
        (reply) => wanted && setPlan(reply),
        (error) => wanted && setRefusal(error),
      );
    }, PAUSE_MS);
    return () => {
      wanted = false;
      clearTimeout(timer);
    };
  }, [asked, axis, situation]);

  return html`<div class="preview" aria-live="polite">
    <h3>Preview</h3>
    ${
      plan
        ? html`<${Planned} axis=${axis} plan=${plan} field=${field} onNearest=${onNearest} />`
        : html`<p class="quiet">${axis.rig.worth ? `Not known: ${axis.rig.worth.why}` : asked ? asking(axis) : "Type a value to see what the move would do."}</p>`
    }
    <${RefusalText} refusal=${refusal} />
  </div>`;
}

/** What is said while a preview has no answer. */
function asking(axis) {
  const names = questionWaitsFor(axis, "preview");
  return names.length ? `Waits for an answer of ${names.join(", ")}…` : "Asking the daemon…";
}

function Planned({ axis, plan, field, onNearest }) {
  const decimals = decimalsOf(axis.info);
  const { unit } = axis.info;
  if (plan.refusal) {
    const { nearest } = plan.refusal;
    return html`<p><span class="mark" data-level="bad">refused</span> ${plan.refusal.message}
      ${
        nearest !== null &&
        plan.refusal.code === "position_limit" &&
        field === "position" &&
        html` <button type="button" class="plain"
          onClick=${() => onNearest(nearest)}>Use ${number(nearest, decimals)}</button>`
      }</p>`;
  }
  const held = (value, error, dimension) => {
    const [shown, off] = [value, error].map((each) => shownQuantity(each, axis.info, dimension));
    const noticed = Math.abs(error) > NOTICED * Math.abs(value);
    return `${number(shown.value, 3)} ${shown.said}${noticed ? ` (${error > 0 ? "+" : ""}${number(off.value, 4)} by rounding)` : ""}`;
  };
  const { known, mark } = axis.condition;
  const end = known ? `${number(plan.position, decimals)} ${unit}` : `(${number(plan.position, decimals)}) ${unit}, ${mark}`;
  const override = axis.state?.speed_override ?? 100;
  return html`<p>${plan.ends ? `${axis.name} ${plan.ends}` : `Ends at ${end}`},
    ${" "}at ${held(plan.velocity, plan.velocity_error, "velocity")}${override === 100 ? "" : ` by the speed override of ${number(override, 0)} %`}, with ${held(plan.acceleration, plan.acceleration_error, "acceleration")}${
      plan.duration_s === null ? "" : `, in ${duration(plan.duration_s)} without settling`
    }.
    ${" "}<span class="quiet">${plan.packets.length} packets, ${duration(plan.bus_s)} on the line at most.</span></p>`;
}
