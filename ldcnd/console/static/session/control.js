/** Control over axes: leases that live as long as this page renews them, and commands under them. */

import { ask, askAtOnce, axisPath, rigPath } from "./api.js";
import { askHolders, changed, rigs } from "./rigs.js";

const LEASE_S = 5;
const RENEWED_EACH_MS = 1_500;
const RENEWAL_PATIENCE_MS = 4_000;
const ENDED = new Set(["lease_expired", "lease_unknown", "lease_held"]);

/** Control of one axis. */
class Lease {
  sequence = 0;
  renewing = false;
  renewedAtMs = performance.now();

  constructor(rig, axis, token) {
    Object.assign(this, { rig, axis, token });
  }

  get body() {
    return { lease: this.token };
  }
}

const held = new Map();

/** Why control was lost last, for people; null when it was not. */
export let lost = null;

/** Whether this page controls the axis. */
export function controls(axis) {
  return held.has(key(axis));
}

/** The axes that this page controls. */
export function controlled() {
  return [...held.values()].map((lease) => lease.axis);
}

/** Take control of an axis; `force` takes it from whoever has it. */
export async function take(axis, force = false) {
  const body = { client: "console", axes: [axis.name], lease_s: LEASE_S, force };
  const reply = await ask(`${rigPath(axis.rig.name)}/rig/acquire`, body);
  held.set(key(axis), new Lease(axis.rig, axis, reply.lease));
  lost = null;
  askHolders();
  changed();
}

/** Give control back. */
export async function release(axis) {
  const lease = held.get(key(axis));
  held.delete(key(axis));
  changed();
  await ask(`${rigPath(axis.rig.name)}/rig/release`, lease.body);
  askHolders();
}

/** Send a command once, under the lease if there is one, meant for this run of the daemon. */
export function command(axis, verb, body = {}, patienceMs = undefined) {
  const lease = held.get(key(axis));
  const authority = lease ? { lease: lease.token, sequence: ++lease.sequence } : {};
  const instance = rigs.get(axis.rig.name)?.daemon?.instance;
  const envelope = { ...authority, ...(instance && { instance }), command_id: crypto.randomUUID() };
  return ask(`${axisPath(axis.rig.name, axis.name)}/${verb}`, { ...given(body), ...envelope }, patienceMs);
}

/** Ask about an axis: `why` and `plan`, which have no effect. */
export function question(axis, verb, body = {}) {
  return ask(`${axisPath(axis.rig.name, axis.name)}/${verb}`, given(body));
}

/** The lease of an axis, for `why`. */
export function leaseOf(axis) {
  return held.get(key(axis))?.token ?? null;
}

/** Renew while the page lives, and give everything back when it goes. */
export function keepControl() {
  setInterval(renewAll, RENEWED_EACH_MS);
  addEventListener("pagehide", () => {
    for (const { rig, body } of held.values()) {
      askAtOnce(`${rigPath(rig.name)}/rig/release`, body, { keepalive: true }).catch(() => {}); // nobody is left to tell
    }
    held.clear();
  });
}

function renewAll() {
  for (const lease of held.values()) if (!lease.renewing) renew(lease);
}

async function renew(lease) {
  const askedAtMs = performance.now();
  lease.renewing = true;
  try {
    await askAtOnce(`${rigPath(lease.rig.name)}/rig/renew`, lease.body, { patienceMs: RENEWAL_PATIENCE_MS });
    lease.renewedAtMs = askedAtMs;
  } catch (error) {
    const outlived = performance.now() - lease.renewedAtMs > LEASE_S * 1e3;
    if (ENDED.has(error.code) || outlived) forget(lease, error);
  } finally {
    lease.renewing = false;
  }
}

function forget(lease, error) {
  if (held.get(key(lease.axis)) !== lease) return;
  held.delete(key(lease.axis));
  lost = `Control of ${lease.axis.name} was lost: ${error.message}`;
  changed();
}

/** Return the fields that have a value: what is left empty is left to the configuration. */
function given(body) {
  return Object.fromEntries(Object.entries(body).filter(([, value]) => value !== null && value !== undefined));
}

function key(axis) {
  return `${axis.rig.name}/${axis.name}`;
}
