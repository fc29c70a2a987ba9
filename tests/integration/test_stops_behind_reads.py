"""However much is read, a stop begins as without; what it takes over real links is for `make bench`."""

import asyncio
import contextlib
from typing import Any

import pytest

from ldcnd.config.rig import load_config
from ldcnd.contract.keys import Keys
from ldcnd.daemon.assembly import build_daemon
from ldcnd.daemon.meta import WORK_PER_STEP
from ldcnd.daemon.requests import EarlyStops
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.net.hand_over import Query
from ldcnd.net.reads import READS_OF_A_CLIENT
from ldcnd.testing.memory_session import MemoryBroker
from tests.support.rig import EPOCH_NS, SIMULATED, RunningRig, running_rig

STOP_MOTOR = 0x7
"""Command code in the low half of the third byte."""
READERS = 4


class Turns:
    """Counts turns of the loop."""

    def __init__(self) -> None:
        self.count = 0
        self._handle: asyncio.Handle | None = None
        self._turn()

    def _turn(self) -> None:
        self.count += 1
        self._handle = asyncio.get_running_loop().call_soon(self._turn)

    def end(self) -> None:
        assert self._handle
        self._handle.cancel()


def stops_sent(rig: RunningRig) -> int:
    (bus,) = rig.daemon.rig.buses
    return sum(
        record.event is WireEvent.SENT and record.data[2:3] != b"" and record.data[2] & 0xF == STOP_MOTOR
        for record in bus.bus.wire_log.records()
    )


async def idle(rig: RunningRig) -> None:
    """Wait until nothing is on the line; while the loop has work the clock stands still, and so does the line."""
    (bus,) = rig.daemon.rig.buses
    while not bus.bus.is_idle:
        await asyncio.sleep(0.001)


async def turns_to_the_first_packet(rig: RunningRig, payloads: list[str]) -> tuple[int, int]:
    """Return in how many turns of the loop a stop reaches the line, and how many payloads are read meanwhile."""
    before, read_before = stops_sent(rig), len(payloads)
    turns = Turns()
    async with asyncio.TaskGroup() as group:
        group.create_task(rig.client.stop("x"), name="stop")
        while stops_sent(rig) == before:
            await asyncio.sleep(0)
        turns.end()
        read = len(payloads) - read_before
    return turns.count, read


@pytest.mark.promise("readers-delay-no-stop")
@pytest.mark.long
async def test_a_stop_reaches_the_line_behind_256_reads_in_as_many_turns_as_without_and_a_step_of_reading_in_each(
    monkeypatch: pytest.MonkeyPatch,
):
    payloads: list[str] = []
    reply = Query.reply

    def counted(self: Query, *args: Any, **kwargs: Any) -> None:
        payloads.append(self.key)
        reply(self, *args, **kwargs)

    monkeypatch.setattr(Query, "reply", counted)
    async with running_rig() as rig, contextlib.AsyncExitStack() as sessions:
        readers = [await sessions.enter_async_context(rig.broker.session()) for _ in range(READERS)]
        await idle(rig)
        alone, _ = await turns_to_the_first_packet(rig, payloads)
        await idle(rig)
        async with asyncio.TaskGroup() as group:
            for reader in readers:
                for _ in range(READS_OF_A_CLIENT):
                    group.create_task(reader.query("ldcn/sim/meta/**"), name="read")
            await asyncio.sleep(0)  # all have asked, none is answered

            behind_reads, read = await turns_to_the_first_packet(rig, payloads)

    print(f"{alone} turns without reads; {behind_reads} turns and {read} payloads of reads behind them")
    assert behind_reads == alone
    assert read <= behind_reads * WORK_PER_STEP


async def test_a_stop_that_comes_before_there_is_a_daemon_is_answered_by_it():
    config, broker, stops = load_config(SIMULATED), MemoryBroker(), EarlyStops()
    async with broker.session() as session, broker.session() as client, asyncio.TaskGroup() as group:
        await stops.declare(session, Keys(config.rig))
        early = group.create_task(client.query("ldcn/sim/@stop/x", timeout_s=60.0, urgent=True), name="early stop")
        await asyncio.sleep(1.0)
        daemon = build_daemon(config, session, lambda: EPOCH_NS, "test", stops=stops)
        running = group.create_task(daemon.run(), name="daemon")

        (answer,) = await early
        latched = daemon.rig.axes["x"].tracker.status.stop_latched
        (later,) = await client.query("ldcn/sim/@stop/y", urgent=True)
        daemon.end()
        await running

    assert (answer.is_error, later.is_error, latched) == (False, False, True)
