"""Subscribe to a moving axis and move it, with nothing but eclipse-zenoh, msgpack and the keys."""

import json
import sys

import msgpack
import zenoh

AXIS = "ldcn/sim/tele/x"
COMMAND = "ldcn/sim/@cmd/x"
TARGET, CLOSE_ENOUGH = 10.0, 0.005


def ask(session: zenoh.Session, verb: str, **payload: object) -> dict[str, object]:
    """Send one command and return its one answer."""
    for reply in session.get(f"{COMMAND}/{verb}", payload=json.dumps(payload), encoding="application/json"):
        if reply.ok is None:
            sys.exit(f"{verb}: {reply.err.payload.to_string() if reply.err else 'no reply'}")
        answer: dict[str, object] = json.loads(reply.ok.payload.to_string())
        return answer
    sys.exit(f"{verb}: no daemon answers; is it running?")


endpoint = sys.argv[1] if len(sys.argv) > 1 else "tcp/127.0.0.1:7447"
config = zenoh.Config.from_json5(json.dumps({"mode": "client", "connect": {"endpoints": [endpoint]}}))
with zenoh.open(config) as session:
    positions = session.declare_subscriber(f"{AXIS}/position", zenoh.handlers.RingChannel(100))
    ask(session, "power", on=True)
    print("accepted:", ask(session, "move_absolute", position=TARGET))
    while True:
        position = msgpack.unpackb(positions.recv().payload.to_bytes())
        print(f"{position['value']:8.3f} {position['unit']}")
        if abs(position["value"] - TARGET) < CLOSE_ENOUGH:
            break
