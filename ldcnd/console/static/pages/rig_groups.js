/** Moves of a group: axes that start in the same servo cycle, or none of them. */

import { html, useId, useState } from "../html.js";
import { Action, enterSends, Panel, Reason, Tick, useOnce } from "../parts/controls.js";
import { askEach, Fates } from "../parts/fates.js";
import { decimalsOf, number } from "../parts/format.js";
import { NumberField, unread } from "../parts/number_field.js";
import { unitsOf } from "../parts/number_text.js";
import { placeText } from "../parts/state.js";
import { moveTogether, previewLine } from "../session/control.js";
import { moves, obstacle } from "../session/obstacles.js";

/** A panel for each group of a rig. */
export function GroupMoves({ rig }) {
  const grouped = [...rig.axes.values()].filter((axis) => axis.info?.group);
  return [...new Set(grouped.map((axis) => axis.info.group))].map((group) => {
    const axes = grouped.filter((axis) => axis.info.group === group);
    return html`<${GroupMove} key=${`${group} ${axes.map(({ unitChanges }) => unitChanges).join()}`} group=${group} axes=${axes} />`;
  });
}

/** All that the conversion of a typed velocity depends on. */
function velocityUnits({ unit, units, g_velocity }) {
  return JSON.stringify([unit, units?.velocity, g_velocity]);
}

function GroupMove({ group, axes }) {
  const [targets, setTargets] = useState({});
  const [speeds, setSpeeds] = useState({});
  const [straight, setStraight] = useState(false);
  const [line, setLine] = useState(null);
  const reason = useId();
  const once = useOnce();
  // what is typed once is converted once: that holds where every unit that may stand behind it means the same to all
  const alike = axes.every(({ info }) => velocityUnits(info) === velocityUnits(axes[0].info));
  const label = (name) => (alike ? "Velocity" : `Velocity of ${name}`);
  const unreadable = unread({ ...targets, ...Object.fromEntries(axes.map(({ name }) => [label(name), speeds[name]])) });
  const body = unreadable ? null : { targets, speeds, straight };
  const hindered = axes.find((axis) => obstacle(axis, "move_absolute"));
  const missing = axes.find(({ name }) => targets[name] === null || targets[name] === undefined);
  const way = hindered
    ? `${hindered.name}: ${obstacle(hindered, "move_absolute")}`
    : (unreadable ??
      (missing ? `The position of ${missing.name} is missing.` : once.obstacle(body, axes.some(moves))));
  const place = `${axes[0].rig.name}/${group}`;
  const send = async (pressed) => {
    const sent = moveTogether(axes, targets, speeds, straight, pressed);
    const of = async ({ name }) => (await sent).replies.find((each) => each.axis === name);
    for (const { error } of await askEach(place, "Move", axes, of)) throw error;
  };
  const move = () => once.send(body, axes.some(moves), send);
  // what a line would be depends on where it begins, and on the speed override
  const situation = JSON.stringify([body, axes.map(({ state }) => [state?.state, state?.speed_override, state?.referenced])]);
  return html`<${Panel} title=${`Group ${group}`} note="All start in the same servo cycle, or none; on a straight line they ramp alike and arrive together.">
    <div class="fields" onKeyDown=${enterSends}>
      ${axes.map(
        (axis) => html`<${NumberField} key=${axis.name} label=${`${axis.name} to`} units=${unitsOf(axis.info, "position")} value=${targets[axis.name]}
        meaning=${(text) => `moves ${axis.name} to ${text};`} hint=${`now ${placeText(axis, decimalsOf(axis.info))}`}
        onChange=${(value) => setTargets((last) => ({ ...last, [axis.name]: value }))} />`,
      )}
      ${(alike ? [axes] : axes.map((axis) => [axis])).map(
        (of) => html`<${NumberField} key=${of[0].name} label=${label(of[0].name)} units=${unitsOf(of[0].info, "velocity")} value=${speeds[of[0].name]}
        hint="empty: the axis default" onChange=${(value) => setSpeeds((last) => ({ ...last, ...Object.fromEntries(of.map(({ name }) => [name, value])) }))} />`,
      )}
    </div>
    <${Tick} label="Straight line" checked=${straight} onChange=${setStraight} />
    <p class="row"><${Action} kind="main" act=${move} obstacle=${way || null}
      reason=${reason}>Move ${axes.map(({ name }) => name).join(" and ")} together<//>
      ${straight && html`<${Action} act=${async () => setLine({ of: situation, ...(await previewLine(axes, targets, speeds)) })} obstacle=${missing || !body ? way : null}
        reason=${reason}>Preview the line<//>`}</p>
    <${Fates} place=${place} />
    ${straight && line?.of === situation && html`<p role="status">${number(line.duration_s, 2)} s, at most
      ${number(line.deviation, 4)} ${axes[0].info.unit} from the line.</p>`}
    ${way && html`<${Reason} id=${reason} text=${way} />`}
  <//>`;
}
