/** Moves of a group: axes that start in the same servo cycle, or none of them. */

import { html, useId, useState } from "../html.js";
import { Action, enterSends, Field, Panel, Reason, Tick } from "../parts/controls.js";
import { decimalsOf, number } from "../parts/format.js";
import { moveTogether, previewLine } from "../session/control.js";
import { obstacle } from "../session/obstacles.js";

/** A panel for each group of a rig. */
export function GroupMoves({ rig }) {
  const grouped = [...rig.axes.values()].filter((axis) => axis.info?.group);
  return [...new Set(grouped.map((axis) => axis.info.group))].map((group) => {
    const axes = grouped.filter((axis) => axis.info.group === group);
    return html`<${GroupMove} key=${group} group=${group} axes=${axes} />`;
  });
}

function GroupMove({ group, axes }) {
  const [targets, setTargets] = useState({});
  const [speed, setSpeed] = useState(null);
  const [straight, setStraight] = useState(false);
  const [line, setLine] = useState(null);
  const reason = useId();
  const hindered = axes.find((axis) => obstacle(axis, "move_absolute"));
  const missing = axes.find(({ name }) => targets[name] === null || targets[name] === undefined);
  const way = hindered
    ? `${hindered.name}: ${obstacle(hindered, "move_absolute")}`
    : missing && `The position of ${missing.name} is missing.`;
  return html`<${Panel} title=${`Group ${group}`} note="All start in the same servo cycle, or none; on a straight line they ramp alike and arrive together.">
    <div class="fields" onKeyDown=${enterSends}>
      ${axes.map(
        ({ name, info, samples }) => html`<${Field} key=${name} label=${`${name} to`} unit=${info.unit} value=${targets[name]}
        hint=${`now ${number(samples.position?.value, decimalsOf(info))}`}
        onChange=${(value) => setTargets({ ...targets, [name]: value })} />`,
      )}
      <${Field} label="Velocity" unit=${`${axes[0].info.unit}/s`} value=${speed} onChange=${setSpeed} hint="empty: the axis default" />
    </div>
    <${Tick} label="Straight line" checked=${straight} onChange=${setStraight} />
    <p class="row"><${Action} kind="main" act=${() => moveTogether(axes, targets, speed, straight)} obstacle=${way || null}
      reason=${reason}>Move ${axes.map(({ name }) => name).join(" and ")} together<//>
      ${straight && html`<${Action} act=${async () => setLine(await previewLine(axes, targets, speed))} obstacle=${missing ? way : null}
        reason=${reason}>Preview the line<//>`}</p>
    ${straight && line && html`<p role="status">${number(line.duration_s, 2)} s, at most
      ${number(line.deviation, 4)} ${axes[0].info.unit} from the line.</p>`}
    ${way && html`<${Reason} id=${reason} text=${way} />`}
  <//>`;
}
