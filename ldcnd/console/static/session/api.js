/** Questions and commands to the console process: JSON by POST, with the token that proves they come from this page. */

const PATIENCE_MS = 15_000;
/** A browser keeps six connections to a host. Questions have two, what calms many axes has two, what is read has one:
 * one is left for a stop, which waits for nothing.
 */
const MOST_QUESTIONS = 2;
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

const question = inTurn(MOST_QUESTIONS);
const oneOfMany = inTurn(MOST_OF_MANY);
const reading = inTurn(MOST_READ);

/** Return a queue that sends at most so many at once, the others in turn. */
function inTurn(most) {
  const waiting = [];
  let underWay = 0;
  return async (send) => {
    if (underWay < most) underWay += 1;
    else await new Promise((resolve) => waiting.push(resolve)); // until one that is over hands on its place
    try {
      return await send();
    } finally {
      if (waiting.length) waiting.shift()();
      else underWay -= 1;
    }
  };
}

/** Ask in turn with the others; a long answer must not keep a stop from its connection. */
export function ask(path, body = {}, patienceMs = PATIENCE_MS) {
  return question(() => askAtOnce(path, body, { patienceMs }));
}

/** Ask for what takes energy out of one of many axes, in turn with the others.
 *
 * Sent at once, they would take every connection, and a stop would wait behind them. What has had no turn within
 * `patienceMs` of the press is not sent: it would end what was begun since.
 */
export function askOfMany(path, body = {}, { patienceMs = PATIENCE_MS } = {}) {
  const signal = AbortSignal.timeout(patienceMs);
  return oneOfMany(() => askAtOnce(path, body, { signal }));
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
  return reading(() => answer(path, { signal: AbortSignal.timeout(PATIENCE_MS) }));
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
