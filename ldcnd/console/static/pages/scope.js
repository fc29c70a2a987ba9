/** The scope: any quantities of any axes against time, as they come. */

import { html, useEffect, useState } from "../html.js";
import { ChartView } from "../parts/chart_view.js";
import { Choice, Panel, Tick } from "../parts/controls.js";
import { NotThere } from "../parts/one_axis.js";
import { channelsOf, Recording } from "../session/channels.js";
import { MOST_CHANNELS } from "../session/contract.js";
import { feed } from "../session/feed.js";
import { axesOf, axisNamed, useRigs } from "../session/rigs.js";

const WINDOWS = [5, 10, 30, 60, 300];
const AT_FIRST = 2;
/** What was chosen is kept while other pages are looked at. */
let remembered = null;

export function ScopePage({ at }) {
  useRigs();
  const axes = axesOf().filter((axis) => axis.info);
  const [, setChosen] = useState(remembered);
  const [windowS, setWindowS] = useState(10);
  const [paused, setPaused] = useState(false);
  if (!at.axis && axes.length) remembered ??= atFirst(axes); // once: rigs that join change no choice
  const named = at.axis ? ofAxis(at) : null;
  const keys = named ?? (at.axis ? [] : (remembered ?? []));
  const recording = useRecording(axes, keys);
  const there = new Set(axes.flatMap(channelsOf).map(({ key }) => key));
  const gone = keys.filter((key) => !there.has(key));

  function toggle(key, on) {
    remembered = on ? [...keys, key] : keys.filter((each) => each !== key);
    setChosen(remembered);
    if (at.axis) location.hash = "#/scope"; // from now on it is the choice that is shown
  }

  if (at.axis && !named) return html`<h1>Scope</h1><${NotThere} at=${at} /><p><a href="#/scope">All channels</a></p>`;
  if (!recording) return html`<h1>Scope</h1><p>No axis is known yet.</p>`;
  return html`<h1>Scope</h1>
    ${gone.length > 0 && html`<p class="notice mark" role="status" data-level="warn">Not there any more: ${gone.join(", ")}</p>`}
    <div class="bench">
      <${Panel} title="Channels" note=${`Up to ${MOST_CHANNELS} at once; each sample is drawn at the instant at which it was true.`}>
        <div class="fields">
          <${Choice} label="Time across" options=${WINDOWS.map((each) => [each, `${each} s`])} value=${windowS}
            onChange=${(value) => setWindowS(Number(value))} />
        </div>
        <div class="channels" tabindex="0" role="region" aria-label="Channels of all axes">
          ${axes.map((axis) => html`<${AxisChannels} key=${`${axis.rig.name}/${axis.name}`} axis=${axis} keys=${keys} onToggle=${toggle} />`)}
        </div>
      <//>
      <${Panel} title="Live" class="panel bench-picture">
        <${ChartView} name="scope" curves=${recording.curves} height=${460}
          live=${{ now: () => recording.now(), windowS, paused, onPause: setPaused }}
          note=${feed.dropped > 0 && html`<span class="quiet">${feed.dropped} frames dropped: this browser is too slow</span>`} />
      <//>
    </div>`;
}

function AxisChannels({ axis, keys, onToggle }) {
  const full = keys.length >= MOST_CHANNELS;
  return html`<fieldset><legend>${axis.rig.name} · ${axis.name}</legend>
    ${channelsOf(axis).map((channel) => {
      const on = keys.includes(channel.key);
      return (
        (on || !full) &&
        html`<${Tick} key=${channel.key} label=${channel.title} checked=${on}
          onChange=${(ticked) => onToggle(channel.key, ticked)} />`
      );
    })}
  </fieldset>`;
}

/** The keys of the axis that the address names: all that tells its motion. */
function ofAxis(at) {
  const axis = axisNamed(at);
  return axis ? channelsOf(axis).filter(({ item }) => item === "position" || item === "velocity").map(({ key }) => key) : null;
}

/** The keys of the first axes' positions. */
function atFirst(axes) {
  const positions = axes.flatMap(channelsOf).filter(({ item, field }) => item === "position" && field === "value");
  return positions.slice(0, AT_FIRST).map((channel) => channel.key);
}

/** Record these channels. */
function useRecording(axes, keys) {
  const [recording, setRecording] = useState(null);
  const all = axes.flatMap(channelsOf);
  const channels = keys.map((key) => all.find((channel) => channel.key === key)).filter(Boolean);
  useEffect(() => {
    if (!axes.length) return undefined;
    const begun = new Recording(channels);
    setRecording(begun);
    return () => begun.close();
  }, [axes.length > 0, channels.map(({ key, unit }) => `${key} ${unit}`).join()]);
  return recording;
}
