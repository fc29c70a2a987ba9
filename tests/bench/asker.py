"""A client that asks the daemon and the bare queryable in turn and prints how long each round trip took."""

import argparse
import json
import random
import time

import zenoh

from tests.bench.bare_queryable import KEY as BARE

COMMAND = "ldcn/bench/@cmd/a1/power"
"""With the loop open already it is one exchange, and nothing changes."""
PAUSE_S = 0.012
"""Mean pause between two queries, random, so that they meet the line at any instant."""


def main(daemon: str, bare: str, count: int) -> None:
    """Ask so many times each, once both answer."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([daemon, bare]))
    config.insert_json5("connect/timeout_ms", "20000")
    config.insert_json5("connect/exit_on_failure", "true")
    dice = random.Random(1)
    sessions = []
    for endpoint in (daemon, bare):
        config.insert_json5("connect/endpoints", json.dumps([endpoint]))
        sessions.append(zenoh.open(config))
    asks = [(sessions[0], COMMAND, b'{"on": false}'), (sessions[1], BARE, b"{}")]
    for ask in asks:
        while _round_trip_s(*ask) is None:
            time.sleep(0.2)
    took: list[list[float]] = [[], []]
    for _ in range(count):
        for number in dice.sample((0, 1), 2):
            time.sleep(dice.uniform(0.0, 2 * PAUSE_S))
            if (took_s := _round_trip_s(*asks[number])) is not None:
                took[number].append(took_s)
    print(json.dumps({"daemon_s": took[0], "bare_s": took[1]}), flush=True)


def _round_trip_s(session: zenoh.Session, key: str, payload: bytes) -> float | None:
    """Ask once; return how long that took, None when there was no good answer."""
    began_s = time.perf_counter()
    replies = list(session.get(key, payload=payload, encoding="application/json", timeout=5.0))
    took_s = time.perf_counter() - began_s
    return took_s if replies and replies[0].ok is not None else None


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("daemon", help="endpoint of the daemon")
    parser.add_argument("bare", help="endpoint of the bare queryable")
    parser.add_argument("count", type=int, help="round trips")
    options = parser.parse_args()
    main(options.daemon, options.bare, options.count)
