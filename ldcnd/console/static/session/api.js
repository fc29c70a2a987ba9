/** Questions and commands to the console process: JSON by POST, with the token that proves they come from this page. */

const PATIENCE_MS = 15_000;
/** As long as a person waits for what a press does: sent later, it would come long after the hand. */
const PRESS_MS = 1_000;
/** As what a daemon refuses: it is certain that nothing was carried out. */
const NOTHING_DONE = 409;
/** A browser keeps six connections to a host. What is asked for has two, of which short questions take one at most, and
 * so does what takes long; what calms many axes has two, what is read has one: one is left for a stop, which waits for
 * nothing.
 */
const MOST_ASKED = 2;
const MOST_QUESTIONS = 1;
const MOST_SLOW = 1;
const MOST_OF_MANY = 2;
const MOST_READ = 1;

/** As the console's gate names it: cookies are shared by all ports of a host. */
const CSRF_COOKIE = `ldcnd_csrf_${location.port}`;
/** As of the loading of this page, so that it may go on ending motions whatever becomes of the cookies. */
const csrf = cookie(CSRF_COOKIE);

let page = null;

/** Say which page sends what is asked from now on: what it may move depends on it. */
export function nameThisPage(name) {
  page = name;
}

/** What a question was refused with: the daemon's error reply, or what came instead of one. */
export class Refusal extends Error {
  constructor(reply, status, rig = null) {
    super(reply.message);
    this.code = reply.code ?? null; // one of the daemon's, each has a page
    this.rig = rig; // of which it was asked
    this.axis = reply.axis ?? null;
    this.remedy = reply.remedy ?? null;
    this.steps = reply.steps ?? [];
    this.nearest = reply.nearest ?? null;
    this.retryable = reply.retryable ?? false;
    this.status = status;
    /** Whether it is certain that nothing was carried out. */
    this.refused = status >= 400 && status < 500;
  }
}

/** Whether the browser has forgotten that this page was let in: the console then carries out its stops only. */
export function loginIsGone() {
  return cookie(CSRF_COOKIE) !== csrf;
}

const asked = inTurn(MOST_ASKED);
const question = inTurn(MOST_QUESTIONS);
const slow = inTurn(MOST_SLOW);
const oneOfMany = inTurn(MOST_OF_MANY);
const reading = inTurn(MOST_READ);

/** Return a queue that sends at most so many at once, the others in turn: presses first, and none that is late.
 *
 * What is sent for a `path` is under way until it is answered; `underWay` has the paths of that.
 */
function inTurn(most) {
  const waiting = [];
  const underWay = [];
  let free = most;
  const turn = (path, pressed) =>
    new Promise((resolve, reject) => {
      const giveUp = () => {
        const names = namesIn(underWay);
        const answered = `${names.join(", ")} ${names.length > 1 ? "have" : "has"} answered`;
        const why = "what was asked before has no answer yet";
        reject(notSent(why, names.length ? `press again once ${answered}` : "press again", axisOf(path)));
      };
      const place = { pressed, resolve, giveUp };
      const question = pressed ? waiting.findIndex((each) => !each.pressed) : -1;
      waiting.splice(question < 0 ? waiting.length : question, 0, place);
      const look = () => {
        if (!waiting.includes(place)) return;
        if (!pressed.isLate) return lookLater();
        waiting.splice(waiting.indexOf(place), 1);
        giveUp();
      };
      const lookLater = () => setTimeout(look, pressed.latestMs - performance.now());
      if (pressed) lookLater();
    });
  const handOn = () => {
    while (waiting.length) {
      const next = waiting.shift();
      if (!next.pressed?.isLate) return next.resolve();
      next.giveUp(); // the timers of a page that is not in sight are late
    }
    free += 1;
  };
  const inLine = async (path, send, pressed = null) => {
    if (free) free -= 1;
    else await turn(path, pressed); // until one that is over hands on its place
    underWay.push(path);
    try {
      return await send();
    } finally {
      underWay.splice(underWay.indexOf(path), 1);
      handOn();
    }
  };
  return Object.assign(inLine, { underWay });
}

/** Return which axis a path is about, null where it is about none. */
function axisOf(path) {
  const [, rig, name] = path.match(/^\/api\/rigs\/([^/]+)\/axes\/([^/]+)\//) ?? [];
  return name ? { name: decodeURIComponent(name), rig: { name: decodeURIComponent(rig) } } : null;
}

/** Return the axes and rigs that these paths are about, each once. */
function namesIn(paths) {
  return [...new Set(paths.map((path) => axisOf(path)?.name ?? rigOf(path)))].filter(Boolean);
}

/** Return whose answers a question at a path waits for before it is sent; none once it is. */
export function waitsFor(path) {
  const line = [question, asked].find(({ underWay }) => !underWay.includes(path));
  return line ? namesIn(line.underWay) : [];
}

/** A press of a person: what it asks for is sent within `PRESS_MS`, and for many axes each within that of the one before. */
export class Press {
  latestMs = performance.now() + PRESS_MS;
  /** When something of it was sent first, by this page's clock; null while it waits for its turn. */
  sentMs = null;

  get isLate() {
    return performance.now() >= this.latestMs;
  }

  /** Something of it is sent. */
  goesOn() {
    this.sentMs ??= performance.now();
    this.latestMs = performance.now() + PRESS_MS;
  }
}

/** Return what refuses a press that was not sent. */
export function notSent(why, remedy, axis = null) {
  const message = `${axis ? `axis ${axis.name}: ` : ""}${why}; nothing was sent`;
  return new Refusal({ code: "command_expired", message, axis: axis?.name, remedy }, NOTHING_DONE, axis?.rig.name);
}

/** Ask a question in turn with the others; a long answer must not keep a press or a stop from its connection. */
export function ask(path, body = {}, patienceMs = PATIENCE_MS) {
  const kind = patienceMs > PATIENCE_MS ? slow : question;
  return kind(path, () => asked(path, () => askAtOnce(path, body, { patienceMs })));
}

/** Send what was pressed: soon, or not at all. */
export function press(path, body, { pressed = new Press(), patienceMs = PATIENCE_MS } = {}) {
  const now = () => {
    // a question of the browser to the person holds a page up, for as long as that takes
    if (pressed.isLate) throw notSent("too long after it was pressed", "press again", axisOf(path));
    pressed.goesOn();
    return askAtOnce(path, body, { patienceMs });
  };
  const send = () => asked(path, now, pressed);
  return patienceMs > PATIENCE_MS ? slow(path, send, pressed) : send();
}

/** Ask for what takes energy out of one of many axes, in turn with the others.
 *
 * Sent at once, they would take every connection, and a stop would wait behind them. What has had no turn within
 * `patienceMs` of the press is not sent: it would end what was begun since.
 */
export function askOfMany(path, body = {}, { patienceMs = PATIENCE_MS } = {}) {
  const signal = AbortSignal.timeout(patienceMs);
  return oneOfMany(path, () => askAtOnce(path, body, { signal }));
}

/** Ask for what takes energy out, past all others. */
export function askAtOnce(path, body = {}, { patienceMs = PATIENCE_MS, keepalive = false, signal = null } = {}) {
  return answer(path, {
    method: "POST",
    headers: {
      "Content-Type": "application/json",
      "X-Ldcnd-Csrf": csrf,
      ...(page && { "X-Ldcnd-Page": page }),
    },
    body: asJson(body),
    priority: "high",
    keepalive,
    signal: signal ?? AbortSignal.timeout(patienceMs),
  });
}

/** Return a message as JSON; throws for a number that is none, which JSON would turn into "left to the configuration". */
export function asJson(message) {
  return JSON.stringify(message, (_name, value) => {
    if (typeof value === "number" && !Number.isFinite(value)) throw new Error("Nothing was sent: a number is none.");
    return value;
  });
}

/** Read something that has no effect, in turn with the others. */
export function read(path) {
  return reading(path, () => answer(path, { signal: AbortSignal.timeout(PATIENCE_MS) }));
}

/** Return the path of an axis below /api. */
export function axisPath(rig, axis) {
  return `/api/rigs/${encodeURIComponent(rig)}/axes/${encodeURIComponent(axis)}`;
}

/** Return the path of a rig below /api. */
export function rigPath(rig) {
  return `/api/rigs/${encodeURIComponent(rig)}`;
}

function rigOf(path) {
  const [, rig] = path.match(/^\/api\/rigs\/([^/]+)\//) ?? [];
  return rig ? decodeURIComponent(rig) : null;
}

async function answer(path, request) {
  let response;
  try {
    response = await fetch(path, { ...request, credentials: "same-origin", redirect: "error" });
  } catch (error) {
    throw new Refusal(silence(error), 0);
  }
  const reply = await response.json().catch(() => ({}));
  if (!response.ok) throw new Refusal(explained(reply, response.status), response.status, rigOf(path));
  return reply;
}

function silence(error) {
  const late = error.name === "TimeoutError";
  return {
    message: late
      ? "No answer in time: what was asked may have happened all the same."
      : "The console process does not answer: what was asked may not have got through.",
    remedy: late ? "Look at the axis before anything else is sent." : "Check that ldcnd console still runs.",
  };
}

function explained(reply, status) {
  if (reply.message) return reply;
  if (status === 401) {
    return { message: "This page has no session any more.", remedy: "Open a new link of ldcnd console." };
  }
  return { message: `The console answered with HTTP status ${status}.` };
}

function cookie(name) {
  return (
    document.cookie
      .split("; ")
      .find((each) => each.startsWith(`${name}=`))
      ?.slice(name.length + 1) ?? ""
  );
}
