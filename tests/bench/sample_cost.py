"""What one sample costs on its way: in the daemon, on a link, in a router, in a client.

Run as `python -m tests.bench.sample_cost`. A router is a Python session in router mode: the same core as zenohd,
without plugins. Processor times are those of the processes, so other load on the machine only blurs them.
"""

import argparse
import asyncio
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

from ldcnd.contract.codec import Encoding, encode
from ldcnd.contract.keys import Keys
from ldcnd.contract.samples import Quality, TelemetryItem
from ldcnd.net.publisher import Publisher, Topic
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings
from ldcnd.testing.memory_session import MemoryBroker
from tests.bench.report import Row, table
from tests.support.process import free_port
from tests.support.router import PROGRAM as ROUTER

KEYS = Keys("bench")
SAMPLES, BATCH, PAUSE_S = 30_000, 20, 0.004
MANY = 9
KEYS_DECLARED = 5000
"""5000 samples a second at most: nothing is dropped on the way."""
TICKS_PER_S = os.sysconf("SC_CLK_TCK")
SUBSCRIBER = """
import json, sys, zenoh
config = {"mode": "client", "connect": {"endpoints": [sys.argv[1]]}, "scouting": {"multicast": {"enabled": False}}}
sessions = [zenoh.open(zenoh.Config.from_json5(json.dumps(config))) for _ in range(int(sys.argv[2]))]
kept = [session.declare_subscriber("ldcn/**", zenoh.handlers.RingChannel(1)) for session in sessions]
print("ready", flush=True)
sys.stdin.read()
"""
CLIENT = """
import asyncio, sys
from ldcnd.net.zenoh_settings import ZenohSettings
from ldcnd.client.rig_client import RigClient
from ldcnd.net.zenoh_session import open_zenoh_session

async def main():
    settings = ZenohSettings(mode="client", connect=(sys.argv[1],))
    async with open_zenoh_session(settings) as session, RigClient(session, "bench").samples() as samples:
        print("ready", flush=True)
        async for _ in samples:
            pass

asyncio.run(main())
"""


def rows(samples: int = SAMPLES) -> list[Row]:
    """Measure everything, each figure with so many samples."""
    unheard_us, _ = asyncio.run(_published(0, samples))
    heard_us, one_us = asyncio.run(_published(1, samples))
    _, many_us = asyncio.run(_published(MANY, samples))
    out_us = (many_us - one_us) / (MANY - 1)
    return [
        Row("payload of a position sample", asyncio.run(payload_bytes()), "bytes"),
        Row("the same on a link, with all that Zenoh adds", asyncio.run(wire_bytes(samples)), "bytes"),
        Row("daemon: to build, encode and publish a sample without subscribers", unheard_us, "us"),
        Row("daemon: the same for a sample with a subscriber", heard_us, "us"),
        Row("router: to take a sample in", one_us - out_us, "us"),
        Row("router: to send it to one more", out_us, "us"),
        Row("our client: to take and decode a sample", asyncio.run(_received_us(samples)), "us"),
        Row("router: memory for a key that is published on", asyncio.run(_key_bytes(samples)), "bytes"),
    ]


def publish_position(topic: Topic, number: int) -> None:
    """Publish what a poll reads, as the daemon does."""
    topic.publish(
        {
            "t": 1_700_000_000_000_000_000 + number,
            "t_error_ns": 250_000,
            "seq": 0,
            "quality": Quality.GOOD,
            "value": 12.345678,
            "unit": "mm",
            "turns": None,
            "counts": 123_456,
            "following_error": 0.001,
        }
    )


async def payload_bytes() -> int:
    """Return how many bytes the payload of a position sample has."""
    async with MemoryBroker().session() as session:
        topic = Publisher(session, KEYS, Encoding.MSGPACK).item("x", TelemetryItem.POSITION)
        publish_position(topic, 0)
        assert topic.sample
        return len(encode(topic.sample, Encoding.MSGPACK)[0])


async def _published(subscribers: int, samples: int) -> tuple[float, float]:
    """Return the processor time of publisher and router for a sample, in us."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with ExitStack() as running:
        router = running.enter_context(program(ROUTER, endpoint))
        if subscribers:
            running.enter_context(program(SUBSCRIBER, endpoint, str(subscribers)))
        async with open_zenoh_session(ZenohSettings(mode="client", connect=(endpoint,))) as session:
            publisher = Publisher(session, KEYS, Encoding.MSGPACK)
            await _publish(publisher, max(1, samples // 10))  # until everything is declared
            await asyncio.sleep(0.5)
            began_s, routed_s = time.process_time(), _processor_s(router.pid)
            await _publish(publisher, samples)
            own_s = time.process_time() - began_s
            await asyncio.sleep(0.5)
            router_s = _processor_s(router.pid) - routed_s
    return own_s / samples * 1e6, router_s / samples * 1e6


async def wire_bytes(samples: int) -> float:
    """Return how many bytes a sample has on the link to a router, several in a batch."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with program(ROUTER, endpoint), program(SUBSCRIBER, endpoint, "1"), Relay(endpoint).running() as relay:
        async with open_zenoh_session(ZenohSettings(mode="client", connect=(relay.endpoint,))) as session:
            publisher = Publisher(session, KEYS, Encoding.MSGPACK)
            await _publish(publisher, max(1, samples // 10))
            await asyncio.sleep(0.5)
            before = relay.bytes
            await _publish(publisher, max(1, samples // 10))
            await asyncio.sleep(0.5)
            return (relay.bytes - before) / (max(1, samples // 10))


async def _publish(publisher: Publisher, count: int) -> None:
    for number in range(count):
        publish_position(publisher.item("x", TelemetryItem.POSITION), number)
        if number % BATCH == BATCH - 1:
            await asyncio.sleep(PAUSE_S)


async def _received_us(samples: int) -> float:
    """Return the processor time of a program that iterates over `RigClient.samples`, for a sample."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with program(ROUTER, endpoint), program(CLIENT, endpoint) as client:
        async with open_zenoh_session(ZenohSettings(mode="client", connect=(endpoint,))) as session:
            publisher = Publisher(session, KEYS, Encoding.MSGPACK)
            await _publish(publisher, max(1, samples // 10))
            await asyncio.sleep(0.5)
            before_s = _processor_s(client.pid)
            await _publish(publisher, samples)
            await asyncio.sleep(0.5)
            return (_processor_s(client.pid) - before_s) / samples * 1e6


async def _key_bytes(samples: int) -> float:
    """Return by how much a router grows with each key that a daemon publishes on and a subscriber takes."""
    keys = min(KEYS_DECLARED, samples)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with program(ROUTER, endpoint) as router, program(SUBSCRIBER, endpoint, "1"):
        async with open_zenoh_session(ZenohSettings(mode="client", connect=(endpoint,))) as session:
            publisher = Publisher(session, KEYS, Encoding.MSGPACK)
            await _publish(publisher, max(1, samples // 10))
            before = _resident_bytes(router.pid)
            for number in range(keys):
                publish_position(publisher.item(f"a{number}", TelemetryItem.POSITION), 0)
                if number % BATCH == 0:
                    await asyncio.sleep(PAUSE_S)
            await asyncio.sleep(2.0)
            return (_resident_bytes(router.pid) - before) / keys


@contextmanager
def program(text: str, *arguments: str) -> "Iterator[subprocess.Popen[bytes]]":
    """Run a Python program until the context ends; it has said "ready" when the context begins."""
    process = subprocess.Popen(  # noqa: S603 - our own programs
        [sys.executable, "-c", text, *arguments], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    )
    try:
        assert process.stdout
        assert process.stdout.readline() == b"ready\n"
        yield process
    finally:
        process.kill()
        process.communicate()


def _processor_s(process: int) -> float:
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICKS_PER_S


def _resident_bytes(process: int) -> int:
    return int(Path(f"/proc/{process}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


class Relay:
    """A TCP relay to a router that counts what is sent to it."""

    def __init__(self, router: str) -> None:
        self.bytes = 0
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self._router_port = int(router.rpartition(":")[2])
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ended = asyncio.Event()

    @contextmanager
    def running(self) -> "Iterator[Relay]":
        """Relay in a thread of its own until the context ends."""
        listening = threading.Event()

        async def serve() -> None:
            server = await asyncio.start_server(self._relay, "127.0.0.1", int(self.endpoint.rpartition(":")[2]))
            self._loop = asyncio.get_running_loop()
            listening.set()
            await self._ended.wait()
            server.close()

        thread = threading.Thread(target=lambda: asyncio.run(serve()))  # which ends what is still relayed
        thread.start()
        listening.wait()
        assert self._loop
        try:
            yield self
        finally:
            self._loop.call_soon_threadsafe(self._ended.set)
            thread.join()

    async def _relay(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there, back = await asyncio.open_connection("127.0.0.1", self._router_port)
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(self._copy(reader, back, counts=True), name="to router")
                group.create_task(self._copy(there, writer, counts=False), name="from router")
        finally:
            for each in (back, writer):
                each.close()
                with suppress(ConnectionError):
                    await each.wait_closed()

    async def _copy(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter, *, counts: bool) -> None:
        while data := await source.read(65536):
            self.bytes += len(data) if counts else 0
            sink.write(data)
        sink.close()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=SAMPLES, help="for each figure")
    print(table(rows(parser.parse_args().samples)))
