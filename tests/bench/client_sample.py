"""What a typed sample of the Python client costs against a bare Zenoh subscriber that unpacks msgpack, in the same run.

Run as `python -m tests.bench.client_sample`; prints the processor time of a sample for both, and the ratio, by rate.
Both take the same samples at the same time, so what else the machine does blurs both alike.
"""

import argparse
import asyncio
import subprocess
import sys
from contextlib import ExitStack
from dataclasses import dataclass

from ldcnd.contract.codec import Encoding
from ldcnd.contract.keys import Keys
from ldcnd.contract.samples import TelemetryItem
from ldcnd.net.publisher import Publisher, Topic
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings
from tests.bench.report import Row
from tests.bench.sample_cost import publish_position
from tests.support.process import free_port

RATES_HZ = (20, 100, 500, 2000)
SAMPLES = 6000
WARM_UP_S = 1.0
SETTLED_S = 0.5
MOST_RATIO = 2.0
REPORTS = """
import sys, threading, time

class Count:
    value = 0

def report():
    for _ in sys.stdin:
        print(time.process_time(), Count.value, flush=True)

threading.Thread(target=report, daemon=True).start()
"""
BARE = f"""{REPORTS}
import json, msgpack, zenoh
config = {{"mode": "client", "connect": {{"endpoints": [sys.argv[1]]}}}}
session = zenoh.open(zenoh.Config.from_json5(json.dumps(config)))

def take(sample):
    msgpack.unpackb(sample.payload.to_bytes())["value"]
    Count.value += 1

subscription = session.declare_subscriber("ldcn/bench/tele/x/position", take)
print("ready", flush=True)
threading.Event().wait()
"""
TYPED = f"""{REPORTS}
import asyncio
from ldcnd.client.axis import Axis
from ldcnd.net.zenoh_settings import ZenohSettings
from ldcnd.client.rig_client import RigClient
from ldcnd.net.zenoh_session import open_zenoh_session

async def main():
    async with open_zenoh_session(ZenohSettings(mode="client", connect=(sys.argv[1],))) as session:
        async with Axis("x", RigClient(session, "bench"), asyncio.get_running_loop()).watched() as x:
            print("ready", flush=True)
            async for sample in x.positions():
                sample.value
                Count.value += 1

asyncio.run(main())
"""


@dataclass(frozen=True, slots=True)
class Cost:
    """Processor time of a sample.

    Attributes:
        rate_hz: samples a second.
        bare_us: of a bare subscriber.
        typed_us: of the Python client.
    """

    rate_hz: int
    bare_us: float
    typed_us: float

    @property
    def ratio(self) -> float:
        """How many times as much a typed sample costs."""
        return self.typed_us / self.bare_us


class Reader:
    """A program that takes samples and says what that has cost."""

    def __init__(self, stack: ExitStack, text: str, *arguments: str) -> None:
        self._process = subprocess.Popen(  # noqa: S603 - our own programs
            [sys.executable, "-c", text, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        stack.callback(self._process.communicate)
        stack.callback(self._process.kill)
        self._line()

    def cost(self) -> tuple[float, int]:
        """Return its processor time, in s, and how many samples it has taken."""
        assert self._process.stdin
        self._process.stdin.write("\n")
        self._process.stdin.flush()
        used, count = self._line().split()
        return float(used), int(count)

    def end(self) -> None:
        """Let it end by itself, and wait for that."""
        self._process.communicate()

    def _line(self) -> str:
        assert self._process.stdout
        return self._process.stdout.readline()


async def costs(rates_hz: tuple[int, ...] = RATES_HZ, samples: int = SAMPLES) -> list[Cost]:
    """Measure at each rate."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    found = []
    async with open_zenoh_session(ZenohSettings(mode="peer", listen=(endpoint,))) as session:
        topic = Publisher(session, Keys("bench"), Encoding.MSGPACK).item("x", TelemetryItem.POSITION)
        with ExitStack() as stack:
            readers = [await asyncio.to_thread(Reader, stack, text, endpoint) for text in (BARE, TYPED)]
            for rate_hz in rates_hz:
                await _publish(topic, rate_hz, round(rate_hz * WARM_UP_S))
                before = [await asyncio.to_thread(reader.cost) for reader in readers]
                await _publish(topic, rate_hz, min(samples, rate_hz * 15))
                await asyncio.sleep(SETTLED_S)
                after = [await asyncio.to_thread(reader.cost) for reader in readers]
                used_us = [
                    (end[0] - begin[0]) / (end[1] - begin[1]) * 1e6 for begin, end in zip(before, after, strict=True)
                ]
                found.append(Cost(rate_hz, *used_us))
    return found


def rows() -> list[Row]:
    """Return the ratios at the rates at which they are told soonest."""
    return [
        Row(
            f"typed sample at {cost.rate_hz}/s, processor time / bare subscriber",
            cost.ratio,
            "",
            MOST_RATIO,
            at_most=True,
        )
        for cost in asyncio.run(costs(RATES_HZ[1:]))
    ]


async def _publish(topic: Topic, rate_hz: int, count: int) -> None:
    loop = asyncio.get_running_loop()
    began_s = loop.time()
    for number in range(count):
        publish_position(topic, number)
        if (ahead_s := began_s + (number + 1) / rate_hz - loop.time()) > 0:
            await asyncio.sleep(ahead_s)


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    for each in asyncio.run(costs()):
        print(
            f"{each.rate_hz:5} samples/s: bare {each.bare_us:6.1f} us, typed {each.typed_us:6.1f} us,"
            f" ratio {each.ratio:.2f}"
        )
