// Subscribe to a moving axis and move it from JavaScript, with nothing of ldcnd: zenoh-ts, msgpack and the keys.
//
//   npm install @eclipse-zenoh/zenoh-ts @msgpack/msgpack
//   node --experimental-websocket --experimental-wasm-modules move_and_watch.mjs ws/127.0.0.1:10000
//
// zenoh-ts connects to the plugin zenoh-plugin-remote-api of a Zenoh router, which is connected to the daemon.
// The options are those of Node.js 20.

import { decode } from "@msgpack/msgpack";
import { Config, Encoding, ReplyError, RingChannel, Session } from "@eclipse-zenoh/zenoh-ts";

const AXIS = "ldcn/sim/tele/x";
const COMMAND = "ldcn/sim/@cmd/x";
const TARGET = 10.0;
const CLOSE_ENOUGH = 0.005;

/** Send one command and return its one answer. */
async function ask(session, verb, payload) {
  const options = { payload: JSON.stringify(payload), encoding: Encoding.APPLICATION_JSON };
  for await (const reply of await session.get(`${COMMAND}/${verb}`, options)) {
    const result = reply.result();
    if (result instanceof ReplyError) throw new Error(`${verb}: ${result.payload().toString()}`);
    return JSON.parse(result.payload().toString());
  }
  throw new Error(`${verb}: no daemon answers; is it running?`);
}

const session = await Session.open(new Config(process.argv[2] ?? "ws/127.0.0.1:10000"));
const positions = await session.declareSubscriber(`${AXIS}/position`, { handler: new RingChannel(100) });
await ask(session, "power", { on: true });
console.log("accepted:", JSON.stringify(await ask(session, "move_absolute", { position: TARGET })));
for await (const sample of positions.receiver()) {
  const position = decode(sample.payload().toBytes(), { useBigInt64: true });
  console.log(`${position.value.toFixed(3)} ${position.unit}`);
  if (Math.abs(position.value - TARGET) < CLOSE_ENOUGH) break;
}
await session.close();
process.exit(0);
