/** Traces: recorded as fast as the line or the drive can, started by a trigger, laid over earlier ones. */

import { html, useId, useMemo, useState } from "../html.js";
import { ChartView } from "../parts/chart_view.js";
import { Action, Choice, Panel, Reason, Tick } from "../parts/controls.js";
import { Curve } from "../parts/curve.js";
import { NumberField, unread } from "../parts/number_field.js";
import { OneAxis } from "../parts/one_axis.js";
import { TraceProgress } from "../parts/trace_progress.js";
import { clock, dateAndClock, duration, words } from "../parts/format.js";
import { axisPath } from "../session/api.js";
import { capture, captures, discard, fetchLast, keep } from "../session/captures.js";
import { look } from "../session/channels.js";
import { MOST_CHANNELS, MOST_SAMPLES, TRACE_UNDER_WAY, TRIGGER_KINDS } from "../session/contract.js";
import { command } from "../session/control.js";
import { obstacle } from "../session/obstacles.js";

const FIRST = { samples: 500, timeout_s: 30, pre_trigger: 0, kind: "rising", level: 0 };

export function TracePage({ at }) {
  const show = (axis) => html`<div class="bench">
    <div><${TraceForm} axis=${axis} /></div>
    <div class="bench-picture"><${Captured} /></div>
  </div>`;
  return html`<${OneAxis} at=${at} page="trace" title="Trace" can=${(axis) => axis.can("trace")}
    none="No axis that can be traced is known yet." show=${show} />`;
}

function TraceForm({ axis }) {
  const all = axis.info.trace_channels;
  const [chosen, setChosen] = useState(all.slice(0, 3));
  const [set, setSet] = useState(FIRST);
  const reason = useId();
  const field = (name) => ({ value: set[name], onChange: (value) => setSet((last) => ({ ...last, [name]: value })) });
  const used = {
    Samples: set.samples,
    Interval: set.interval_ms,
    ...(set.trigger && { Level: set.level, "Samples before trigger": set.pre_trigger, "Wait at most": set.timeout_s }),
  };
  const under = axis.trace && TRACE_UNDER_WAY.includes(axis.trace.phase);
  const way =
    obstacle(axis, "trace") ??
    (chosen.length ? null : "Choose a channel.") ??
    (!set.trigger || chosen.includes(set.trigger) ? null : `The trigger looks at ${words(set.trigger)}, which is not recorded.`) ??
    (under ? "A trace is under way." : null) ??
    unread(used) ??
    (set.samples ? null : "How many samples?") ??
    (set.trigger && set.timeout_s === 0 ? "How long may it wait for the trigger?" : null);
  const request = {
    channels: chosen,
    samples: set.samples,
    timeout_s: (set.trigger ? set.timeout_s : null) ?? FIRST.timeout_s,
    interval_s: set.interval_ms ? set.interval_ms / 1e3 : "fastest",
    ...(set.trigger && {
      pre_trigger: set.pre_trigger ?? 0,
      trigger: { channel: set.trigger, kind: set.kind, level: set.level ?? 0 },
    }),
  };

  return html`<${Panel} title=${`Record ${axis.name}`} note="Recording moves nothing.">
    <fieldset class="ticks"><legend>Channels, up to ${MOST_CHANNELS}</legend>
      ${all.map(
        (name) => html`<${Tick} key=${name} label=${words(name)} checked=${chosen.includes(name)}
        onChange=${(on) => setChosen(on ? [...chosen, name].slice(0, MOST_CHANNELS) : chosen.filter((each) => each !== name))} />`,
      )}
    </fieldset>
    <div class="fields">
      <${NumberField} label="Samples" ...${field("samples")} whole min=${2} max=${MOST_SAMPLES} />
      <${NumberField} label="Interval" min=${0} unit="ms" ...${field("interval_ms")} hint="empty: as fast as can be" />
      <${Choice} label="Trigger" options=${[["", "none: at once"], ...chosen.map((name) => [name, words(name)])]}
        missing=${set.trigger && `${words(set.trigger)}: not recorded`} ...${field("trigger")} />
      ${
        set.trigger &&
        html`<${Choice} label="When it is" options=${TRIGGER_KINDS.map((each) => [each, each])} ...${field("kind")} />
        <${NumberField} label="Level" hint="not used for signals" ...${field("level")} />
        <${NumberField} label="Samples before trigger" ...${field("pre_trigger")} whole min=${0} />
        <${NumberField} label="Wait at most" min=${0} unit="s" ...${field("timeout_s")} />`
      }
    </div>
    <p class="row">
      <${Action} act=${() => capture(axis, request)} obstacle=${way} reason=${reason} kind="main">Record<//>
      <${Action} act=${() => command(axis, "trace_abort")} obstacle=${under ? null : "No trace is under way."}>Abort<//>
      <${Action} act=${async () => keep(await fetchLast(axis))}
        obstacle=${under ? "A trace is under way." : null}>Fetch the last one<//>
    </p>
    ${way && html`<${Reason} id=${reason} text=${way} />`}
    <${TraceProgress} trace=${axis.trace} />
  <//>`;
}

function Captured() {
  const kept = captures();
  const [hidden, setHidden] = useState(() => new Set());
  const shown = kept.filter((one) => !hidden.has(one.id));
  const curves = useMemo(() => curvesOf(shown), [shown.map((one) => one.id).join()]);
  if (!kept.length)
    return html`<${Panel} title="Captures"><p class="quiet">Nothing was recorded on this page yet.</p><//>`;
  const toggle = (one, on) =>
    setHidden(new Set([...kept.map((each) => each.id)].filter((id) => (id === one.id ? !on : hidden.has(id)))));
  return html`<${Panel} title="Captures">
    <${ChartView} name="trace" curves=${curves} height=${420} />
    <ul class="captures">${kept.map(
      (one) => html`<li key=${one.id}>
      <${Tick} label=${`${one.axis.name}, ${dateAndClock(one.header.t)}`} checked=${!hidden.has(one.id)}
        onChange=${(on) => toggle(one, on)} />
      <span class="quiet">${one.seconds.length} samples in ${duration(one.seconds.at(-1) - one.seconds[0])}${
        one.header.trigger ? `, trigger ${one.header.trigger.channel} ${one.header.trigger.kind} at 0 s` : ""
      }${
        one.header.missed ? `, ${one.header.missed} missed` : ""
      }${one.header.problem ? `; ${one.header.problem}` : ""}</span>
      <a href=${`${axisPath(one.axis.rig.name, one.axis.name)}/trace`} download=${`${one.axis.name}-trace.json`}>last trace of ${one.axis.name}, for ldcnd trace show</a>
      <button type="button" class="plain"
        onClick=${() => discard(one)}>Forget<span class="unseen"> the capture of ${clock(one.header.t)}</span></button>
    </li>`,
    )}</ul>
  <//>`;
}

/** The newest in full, earlier ones dashed: they are told apart without colour. */
function curvesOf(shown) {
  let count = 0;
  return shown.flatMap((one, nth) =>
    one.channels.map(
      (channel) =>
        new Curve({
          label: `${one.axis.name} ${words(channel.name)}${nth ? ` (${clock(one.header.t)})` : ""}`,
          unit: channel.unit,
          pane: channel.name === "following_error" ? `${channel.unit} error` : channel.unit,
          step: channel.signal,
          colour: look(count++).colour,
          dash: nth
            ? [
                [8, 4],
                [2, 3],
              ][(nth - 1) % 2]
            : [],
          xs: one.seconds,
          ys: channel.values,
        }),
    ),
  );
}
