"""How long a stop waits while others read: its first bit and its answer, beside the same without load in one run.

Run as `python -m tests.bench.stops_under_load`. The daemon runs in this process; who stops and who reads are processes
of their own on bare Zenoh. Rounds without and with a load take turns, so that what else uses the machine falls on both.
Daemon and stopping client go ahead of other programs, the readers behind: they stand for other machines.
"""

import argparse
import asyncio
import contextlib
import gc
import json
import logging
import multiprocessing
import os
import signal
import sys
import time
from asyncio.subprocess import PIPE, Process
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

import structlog

from ldcnd.config.plan import plan_rig
from ldcnd.config.rig import load_config
from ldcnd.daemon.assembly import build_daemon
from ldcnd.daemon.daemon import Daemon
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings
from tests.bench.report import Row, table
from tests.support.process import ROOT, free_port
from tests.support.rig import SIMULATED

STOPS, ROUNDS = 25, 4
STOP_MOTOR = 0x7
"""Command code in the low half of the third byte."""
SCHEDULING_S = 0.020
"""How late the machine may let the daemon run, beyond the bound of the line."""
AHEAD, BEHIND = -10, 10
"""Nice value of the daemon and of who stops (`deploy/drop-ins/nice.conf`); how much higher that of the readers is."""


@dataclass(frozen=True, slots=True)
class Load:
    """Clients that read.

    Attributes:
        what: the selector, below the rig.
        links: how many clients.
        outstanding: unanswered queries of each.
        freeze_s: they read nothing for so long, then others take their place.
    """

    what: str
    links: int
    outstanding: int
    freeze_s: float | None = None

    @property
    def arguments(self) -> tuple[str, ...]:
        """As `tests.bench.reading_clients` takes them."""
        freeze = () if self.freeze_s is None else ("--freeze", str(self.freeze_s))
        return (f"ldcn/sim/{self.what}", str(self.links), str(self.outstanding), *freeze)


LOADS = {
    "1 client, 32 outstanding get meta/**": Load("meta/**", 1, 32),
    "3 clients, 64 outstanding get tele/** each": Load("tele/**", 3, 64),
    "3 clients, 64 outstanding get meta/** each": Load("meta/**", 3, 64),
    "4 links, 300 get meta/** each, that stop reading and reconnect": Load("meta/**", 4, 300, 1.0),
}
STOPPER = """
import json, sys, time, zenoh
from tests.bench.reading_clients import session
link, took = session(sys.argv[1]), []
for _ in range(int(sys.argv[2])):
    began_s = time.monotonic()
    replies = list(link.get("ldcn/sim/@stop/x", timeout=20.0, priority=zenoh.Priority.REAL_TIME, express=True))
    took.append((began_s, time.monotonic(), bool(replies) and replies[0].ok is not None))
    time.sleep(0.03)
print(json.dumps(took))
"""


@dataclass(slots=True)
class Stops:
    """What stops of one kind of round took, in seconds, and how many had no good answer."""

    begun_s: list[float] = field(default_factory=list)
    answered_s: list[float] = field(default_factory=list)
    failed: int = 0


def rows() -> list[Row]:
    """Measure once, in a process of its own."""
    with multiprocessing.get_context("spawn").Pool(1, _go_ahead) as process:
        return process.apply(_measure)


def _measure() -> list[Row]:
    return asyncio.run(_measured(ROUNDS, STOPS))


def _go_ahead() -> None:
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    with contextlib.suppress(OSError):
        os.nice(AHEAD)
        # where sessions share the processor evenly, nice only counts within one
        Path("/proc/self/autogroup").write_text(str(AHEAD))


async def _measured(rounds: int, stops: int) -> list[Row]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    found: list[Row] = []
    async with open_zenoh_session(ZenohSettings(listen=(endpoint,))) as session, asyncio.TaskGroup() as group:
        daemon = build_daemon(load_config(SIMULATED), session, time.time_ns, "bench")
        running = group.create_task(daemon.run(), name="daemon")
        await daemon.wait_up()
        gc.collect()
        gc.freeze()  # as the service does after start-up
        bound_s = max(bus.stop_wait_s for bus in plan_rig(daemon.config).buses)
        for name, load in LOADS.items():
            quiet, loaded = await compared(daemon, endpoint, load, rounds, stops)
            found += _rows(name, quiet, loaded, bound_s)
        daemon.end()
        await running
    return found


async def compared(
    daemon: Daemon, endpoint: str, load: Load, rounds: int, stops: int, nice: int = BEHIND
) -> tuple[Stops, Stops]:
    """Return what stops take without and with a load, in turn; the readers have a nice value."""
    quiet, loaded = Stops(), Stops()
    for _ in range(rounds):
        await _stop(daemon, endpoint, stops, quiet)
        async with reading(endpoint, load, nice):
            await _stop(daemon, endpoint, stops, loaded)
    return quiet, loaded


@asynccontextmanager
async def reading(endpoint: str, load: Load, nice: int) -> AsyncIterator[Process]:
    """Have clients read until the context ends."""
    clients = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "tests.bench.reading_clients", endpoint, *load.arguments, cwd=ROOT, stdout=PIPE,
        start_new_session=True, preexec_fn=lambda: os.nice(nice),
    )  # fmt: skip
    try:
        assert clients.stdout
        await clients.stdout.readline()
        yield clients
    finally:
        os.killpg(clients.pid, signal.SIGKILL)
        await clients.wait()


async def _stop(daemon: Daemon, endpoint: str, stops: int, into: Stops) -> None:
    """Stop an axis again and again, and enter what that took."""
    stopper = await asyncio.create_subprocess_exec(sys.executable, "-c", STOPPER, endpoint, str(stops), stdout=PIPE)
    printed, _ = await stopper.communicate()
    sent_s = list(_stops_sent(daemon))
    for began_s, end_s, good in json.loads(printed):
        first_s = next((at_s for at_s in sent_s if began_s < at_s < end_s), None)
        if first_s is None or not good:
            into.failed += 1
            continue
        into.begun_s.append(first_s - began_s)
        into.answered_s.append(end_s - began_s)


def _stops_sent(daemon: Daemon) -> Iterator[float]:
    """Yield when stops went out, as the flight recorder has it."""
    for bus in daemon.rig.buses:
        for record in bus.bus.wire_log.records():
            if record.event is WireEvent.SENT and record.data[2:3] and record.data[2] & 0xF == STOP_MOTOR:
                yield record.at_s


def _rows(name: str, quiet: Stops, loaded: Stops, bound_s: float) -> list[Row]:
    begun, answered = f"{name}: stop begun", f"{name}: stop answered"
    begun_ratio = _median(loaded.begun_s) / _median(quiet.begun_s)
    answered_ratio = _median(loaded.answered_s) / _median(quiet.answered_s)
    longest_ms, wanted_ms = max(loaded.begun_s) * 1e3, (bound_s + SCHEDULING_S) * 1e3
    busy = "stops without load took longer" if max(quiet.begun_s) > bound_s + SCHEDULING_S / 2 else ""
    return [
        Row(f"{begun}, median", _median(loaded.begun_s) * 1e3, "ms"),
        Row(f"{begun}, median / without load", begun_ratio, "", 3.0, at_most=True),
        Row(f"{begun}, longest without load", max(quiet.begun_s) * 1e3, "ms"),
        Row(f"{begun}, longest", longest_ms, "ms", wanted_ms, at_most=True, doubt=busy),
        Row(f"{answered}, median", _median(loaded.answered_s) * 1e3, "ms"),
        Row(f"{answered}, median / without load", answered_ratio, "", 10.0, at_most=True),
        Row(f"{answered}, longest", max(loaded.answered_s) * 1e3, "ms"),
        Row(f"{name}: stops without a good answer", quiet.failed + loaded.failed, "", 0.0, at_most=True, exact=True),
    ]


def _median(values: list[float]) -> float:
    return sorted(values)[len(values) // 2]


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    print(table(rows()))
