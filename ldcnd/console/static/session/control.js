/** Control over axes: the console process holds it for this page for as long as the page's web socket is open. */

import { clock } from "../parts/format.js";
import { ask, askAtOnce, askOfMany, asJson, axisPath, nameThisPage, press, Press, rigPath, waitsFor } from "./api.js";
import { moves } from "./obstacles.js";
import { changed, namesOf, rigs } from "./rigs.js";

const OPEN_AGAIN_MS = 1_000;
/** As the console's `HELD_S` wants it, several times over. */
const HELD_EACH_MS = 100;
const HOLDERS_EACH_MS = 500;
/** A daemon tells of control at once: who it says controls an axis for longer does. */
const OTHERWISE_MS = 2_000;
const UNTOLD = "the daemon says that no client controls it.";
/** The axes that this page controls. */
const held = new Set();

/** The name under which this page controls axes; null while it is not connected. */
export let client = null;

/** The axes of which control was lost, by why, until the operator has seen it; empty when none was. */
export const lost = new Map();

/** Why a jog did not begin, or what went wrong in it; null when nothing did. */
export let jogRefusal = null;

/** Since when a daemon has said otherwise of axes that this page controls, by this page's clock. */
const otherwise = new Map();

let socket = null;
let holding = 0;

/** Forget what was lost: the operator has seen it. */
export function dismissLost() {
  lost.clear();
  changed();
}

/** Whether this page controls the axis. */
export function controls(axis) {
  return held.has(axis);
}

/** The axes that this page controls. */
export function controlled() {
  return [...held];
}

/** Take control of axes of one rig; `force` takes them from their holders. */
export async function take(axes, force = false) {
  const body = { axes: axes.map((axis) => axis.name), force };
  await press(`${rigPath(axes[0].rig.name)}/control`, body);
  for (const axis of axes) {
    held.add(axis);
    otherwise.delete(axis);
  }
  forgetLossOf(axes);
  changed();
}

/** Give up control of axes of one rig; what moves is halted before. */
export async function release(axes) {
  await askAtOnce(`${rigPath(axes[0].rig.name)}/release`, { axes: axes.map((axis) => axis.name) });
  for (const axis of axes) held.delete(axis);
  changed();
}

/** Send a command once, under this page's control if it has it, meant for this run of the daemon.
 *
 * What takes energy out waits behind no question of this page. All else the daemon refuses behind a stop of anybody that
 * this page did not show when it was pressed.
 */
export function command(axis, verb, body = {}, patienceMs = undefined, pressed = undefined) {
  return sent(axis, verb, body, patienceMs, askAtOnce, pressed);
}

/** Send one of the commands that a press sends to many axes: a stop waits behind none of them. */
export function commandOfMany(axis, verb, body, pressed) {
  return sent(axis, verb, body, undefined, askOfMany, pressed);
}

async function sent(axis, verb, body, patienceMs, calm, pressed = new Press()) {
  const message = { ...body, ...runOf(axis), command_id: crypto.randomUUID() };
  const path = `${axisPath(axis.rig.name, axis.name)}/${verb}`;
  const relieves = axis.rig.commands.get(verb)?.effect === "rest" || (verb === "power" && body.on === false);
  if (!relieves) {
    const known = given({ after_stops: await axis.stopsNow(), ...message });
    return isQuestion(axis.rig, verb) ? ask(path, known, patienceMs) : press(path, known, { pressed, patienceMs });
  }
  const answer = calm(path, given(message), { patienceMs });
  axis.noteStop(answer.then(({ stops }) => stops));
  return answer;
}

/** Whether a command changes nothing, as the daemon says: it may wait for its turn. */
function isQuestion(rig, verb) {
  return rig.commands.get(verb)?.effect === "question";
}

/** How many stops this page knows of at this moment of each of these axes that its rig has, by name. */
export async function stopsOf(axes) {
  const known = axes.filter(({ info }) => info);
  const counts = await Promise.all(known.map((axis) => axis.stopsNow()));
  return given(Object.fromEntries(known.map(({ name }, at) => [name, counts[at]])));
}

/** The run of the daemon whose values and units this page shows: another one may mean something else by a number. */
function runOf(axis) {
  const instance = axis.rig.daemon?.instance;
  return instance ? { instance } : {};
}

/** Start absolute moves of the members of a group in the same servo cycle; `targets` are positions by axis name. */
export async function moveTogether(axes, targets, velocities, straight = false, pressed = new Press()) {
  const [run, wanted, stops] = [runOf(axes[0]), shares(axes, targets, velocities), await stopsOf(axes)];
  const moves = wanted.map((move) => ({ ...move, ...run, after_stops: stops[move.axis], command_id: crypto.randomUUID() }));
  const body = { moves, ...(straight && { path: "linear" }) };
  return press(`${rigPath(axes[0].rig.name)}/rig/move_together`, body, { pressed });
}

/** Scale every velocity of a rig, in percent; 0 halts what moves. */
export async function setSpeedOverride(rig, percent) {
  const [path, axes] = [`${rigPath(rig.name)}/rig/set_speed_override`, [...rig.axes.values()]];
  const pressed = new Press();
  if (percent > 0) return press(path, { percent, after_stops: await stopsOf(axes) }, { pressed });
  const answer = askAtOnce(path, { percent });
  for (const axis of axes) {
    axis.notePress();
    axis.noteStop(answer.then(({ stops }) => stops?.[axis.name]));
  }
  return answer;
}

/** Ask how long a straight line would take and how far from it the axes would get; no effect. */
export function previewLine(axes, targets, velocities) {
  const moves = shares(axes, targets, velocities);
  return ask(`${rigPath(axes[0].rig.name)}/rig/preview_together`, { moves, path: "linear" });
}

function shares(axes, targets, velocities) {
  return axes.map(({ name }) => given({ axis: name, position: targets[name], velocity: velocities[name] }));
}

/** Ask a rig for what concerns a whole line; the console adds this page's leases. */
export function ofRig(rig, verb, body = {}) {
  return (isQuestion(rig, verb) ? ask : press)(`${rigPath(rig.name)}/rig/${verb}`, given(body));
}

/** Begin a sequence under this page's control, or have it wait; it is not sent twice. */
export function ofRun(rig, what, body, pressed = undefined) {
  return press(`${rigPath(rig.name)}/${what}`, body, { pressed });
}

/** Return whose answers a question about an axis waits for before it is sent, by name. */
export function questionWaitsFor(axis, verb) {
  return waitsFor(`${axisPath(axis.rig.name, axis.name)}/${verb}`);
}

/** Ask about an axis: `why` and `plan`, which have no effect. */
export function question(axis, verb, body = {}) {
  return ask(`${axisPath(axis.rig.name, axis.name)}/${verb}`, given(body));
}

/** Run an axis until `endJog`; the console halts it by itself when this page falls silent. */
export async function beginJog(axis, velocity) {
  endJog();
  jogRefusal = null;
  const mine = setInterval(() => say({ held: true }), HELD_EACH_MS);
  holding = mine;
  changed();
  const jog = { rig: axis.rig.name, axis: axis.name, velocity, ...runOf(axis) };
  try {
    const after_stops = await axis.stopsNow();
    if (holding === mine) say({ jog: given({ ...jog, after_stops }) });
  } catch (refusal) {
    if (holding !== mine) return;
    endJog();
    jogRefusal = refusal;
    changed();
  }
}

/** Forget why the last jog was refused: its page is left. */
export function forgetJogRefusal() {
  jogRefusal = null;
}

/** Halt the axis that jogs. */
export function endJog() {
  if (!holding) return;
  clearInterval(holding);
  holding = 0;
  say({ held: false });
}

function say(message) {
  if (socket?.readyState === WebSocket.OPEN) socket.send(asJson(message));
}

/** Connect, again whenever the connection is lost; warn before a page goes whose axes move. */
export function keepControl() {
  open();
  setInterval(lookAtHolders, HOLDERS_EACH_MS);
  addEventListener("beforeunload", (event) => {
    if ([...held].some(moves)) event.preventDefault();
  });
}

function open() {
  socket = new WebSocket(`${location.origin.replace(/^http/, "ws")}/api/page`);
  socket.onmessage = ({ data }) => {
    const told = JSON.parse(data);
    if (told.page) {
      client = told.client;
      nameThisPage(told.page);
    } else if (told.lost) forget(told.lost);
    else if (told.jog_over) endJog();
    else if (told.refused) {
      endJog();
      jogRefusal = told.refused;
    }
    changed();
  };
  socket.onclose = () => {
    endJog();
    client = null;
    nameThisPage(null);
    for (const axis of held) noteLost(axis, "this page has lost its connection to the console. The daemon, if it still runs, halts within 3 s what the page moved.");
    held.clear();
    changed();
    setTimeout(open, OPEN_AGAIN_MS);
  };
}

function forget({ rig, axis: name, message, taken_by: taker }) {
  const axis = rigs.get(rig)?.axes.get(name);
  const seen = lost.get(UNTOLD)?.axes.includes(axis); // in the daemon's values, which do not say why
  if (seen) forgetLossOf([axis]);
  if (held.delete(axis) || seen) noteLost(axis, message, taker);
}

/** Give up the belief in control of what a daemon says otherwise of: the word of its end has got lost. */
function lookAtHolders() {
  const nowMs = performance.now();
  for (const axis of [...held]) {
    if (!isSaidOtherwise(axis)) otherwise.delete(axis);
    else if (!otherwise.has(axis)) otherwise.set(axis, nowMs);
    else if (nowMs - otherwise.get(axis) > OTHERWISE_MS) {
      held.delete(axis);
      noteLost(axis, UNTOLD, axis.holder);
      changed();
    }
  }
}

function isSaidOtherwise(axis) {
  const { run, runs } = axis.rig;
  const isLent = runs && run.axes.includes(axis.name); // no client has it for a moment when a run ends
  const isKnown = axis.condition.live && axis.holder !== "";
  return isKnown && !isLent && axis.holder !== client;
}

/** Forget that control of these axes was lost: they were taken again, or it is told anew. */
function forgetLossOf(axes) {
  for (const [key, loss] of lost) {
    const left = loss.axes.filter((axis) => !axes.includes(axis));
    if (left.length) lost.set(key, { ...loss, axes: left });
    else lost.delete(key);
  }
}

function noteLost(axis, why, taker) {
  const key = taker ? `${taker} ` : why;
  lost.set(key, { taker, why, at: Date.now() * 1e6, axes: [...(lost.get(key)?.axes ?? []), axis] });
}

/** Return what was lost, a sentence for each reason. */
export function lostInWords() {
  return [...lost.values()].map(({ taker, why, at, axes }) => {
    const [names, when] = [namesOf(axes), clock(at).slice(0, -4)];
    return taker ? `At ${when} ${taker} took control of ${names}.` : `At ${when} control of ${names} was lost: ${why}`;
  });
}

/** Return the fields that have a value: what is left empty is left to the configuration. */
function given(body) {
  return Object.fromEntries(Object.entries(body).filter(([, value]) => value !== null && value !== undefined));
}
