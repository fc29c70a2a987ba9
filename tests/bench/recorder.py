"""How many samples a second a recorder takes on one processor, with every sample in its MCAP file.

Run as `python -m tests.bench.recorder`: prints the processor time of a sample, and what of it a bare subscriber takes
that does nothing but unpack. Afterwards every sample of the file is held to the model of its schema.
"""

import argparse
import asyncio
import sys
import tempfile
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

from mcap.reader import make_reader

from ldcnd.contract.codec import Encoding
from ldcnd.contract.keys import Keys
from ldcnd.contract.samples import PositionSample, TelemetryItem
from ldcnd.net.publisher import Publisher
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings
from tests.bench.client_sample import BARE, Reader
from tests.bench.sample_cost import publish_position
from tests.support.process import free_port

AXES = 31
RATE_HZ = 12_000
"""Of all axes together: the publisher, on the other processor, makes so many."""
SECONDS = 8.0
ROUND_S = 0.004
MOST_AT_ONCE = 100
"""Of a longer burst Zenoh drops what its queue does not take, in the publisher: telemetry makes no publisher wait."""
SETTLED_S = 1.5
RECORDING = """
import asyncio, gc, sys, threading, time
from pathlib import Path
from ldcnd.net.zenoh_settings import ZenohSettings
from ldcnd.client.rig_client import RigClient
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.lab.recording.recorder import KEPT_SAMPLES, LINGER_S, Recorder

async def main():
    gc.freeze()  # as the command line does
    loop = asyncio.get_running_loop()
    with Recorder(Path(sys.argv[2]), {}, time.time_ns, 10**9) as recorder:

        def report():
            for _ in sys.stdin:
                print(time.process_time(), recorder.messages, flush=True)
            loop.call_soon_threadsafe(recorder.end)

        async with open_zenoh_session(ZenohSettings(mode="client", connect=(sys.argv[1],))) as session:
            async with RigClient(session, "bench").published(recorder.take, KEPT_SAMPLES, LINGER_S) as gave_way:
                threading.Thread(target=report, daemon=True).start()
                print("ready", flush=True)
                await recorder.run(gave_way)

asyncio.run(main())
"""


@dataclass(frozen=True, slots=True)
class Cost:
    """What recording costs.

    Attributes:
        sample_us: processor time of a sample, in its file.
        bare_us: of a bare subscriber, in the same run, which takes the samples of one axis.
        published, recorded: how many samples were.
        valid: how many of those in the file have the schema that it names.
    """

    sample_us: float
    bare_us: float
    published: int
    recorded: int
    valid: int


async def cost(seconds: float = SECONDS, rate_hz: int = RATE_HZ) -> Cost:
    """Measure for so long at so many samples a second."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with tempfile.TemporaryDirectory() as folder, ExitStack() as stack:
        path = Path(folder) / "run.mcap"
        async with open_zenoh_session(ZenohSettings(mode="peer", listen=(endpoint,))) as session:
            publisher = Publisher(session, Keys("bench"), Encoding.MSGPACK)
            axes = ["x", *(f"a{number}" for number in range(1, AXES))]
            topics = [publisher.item(axis, TelemetryItem.POSITION) for axis in axes]
            bare = await asyncio.to_thread(Reader, stack, BARE, endpoint)
            recorder = await asyncio.to_thread(Reader, stack, RECORDING, endpoint, str(path))
            loop = asyncio.get_running_loop()
            await asyncio.sleep(SETTLED_S)  # until the subscriptions are known here
            before = [await asyncio.to_thread(reader.cost) for reader in (bare, recorder)]
            begun_s, number = loop.time(), 0
            while (passed_s := loop.time() - begun_s) < seconds:
                due = min(rate_hz * passed_s, number + MOST_AT_ONCE)
                while number < due:
                    publish_position(topics[number % AXES], number)
                    number += 1
                await asyncio.sleep(ROUND_S)
            await asyncio.sleep(SETTLED_S)
            after = [await asyncio.to_thread(reader.cost) for reader in (bare, recorder)]
            await asyncio.to_thread(recorder.end)
        used = [(end[0] - begin[0]) / max(1, end[1] - begin[1]) * 1e6 for begin, end in zip(before, after, strict=True)]
        return Cost(used[1], used[0], number, after[1][1], _valid(path))


def _valid(path: Path) -> int:
    """Return how many samples of a file are what their schemas say."""
    with path.open("rb") as stream:
        messages = (message for _, _, message in make_reader(stream).iter_messages())
        return len([PositionSample.model_validate_json(message.data, strict=True) for message in messages])


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    found = asyncio.run(cost())
    print(
        f"{found.sample_us:.1f} us of processor a sample, {1e6 / found.sample_us:.0f} samples a second and processor;"
        f" a bare subscriber {found.bare_us:.1f} us; {found.published} published, {found.recorded} recorded,"
        f" {found.valid} valid"
    )
    sys.exit(0 if found.published == found.recorded == found.valid else 1)
