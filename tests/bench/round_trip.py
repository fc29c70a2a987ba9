"""How long a command takes beyond Zenoh and the wire: the daemon's own share of a query's round trip.

Run as `python -m tests.bench.round_trip`. A client in a process of its own asks a bare queryable and commands an axis
in turn; both are served by one session in one process. The line is simulated in another one, behind a pseudo-terminal:
what the simulated drive does is not the daemon's share. From a command's round trip the time on the wire is taken away,
first byte of the request to last byte of the reply, as the flight recorder of the line has it. What is left is compared
with the bare queryable: it is Zenoh twice and the daemon once.
"""

import argparse
import asyncio
import json
import logging
import sys
import tempfile
import time
from asyncio.subprocess import PIPE
from dataclasses import replace
from pathlib import Path

import structlog

from ldcnd.config.rig import RigConfig
from ldcnd.daemon.assembly import build_daemon
from ldcnd.daemon.service import held_awake, settle_heap
from ldcnd.line.flight_recorder import WireEvent, WireRecord
from ldcnd.net.hand_over import Query
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings
from tests.bench.report import Row, table
from tests.support.process import free_port, simulated_terminal

ROUNDS = 400
SHARE_US, LATE_SHARE_US = 500.0, 1000.0
"""In the median, and in 99 of 100 commands, against the median of the bare queryable."""
BARE = "ldcn/bare/@cmd/x/power"
STOP_MOTOR = 0x7
"""Command code in the low half of the third byte: what `power off` sends."""
CLIENT = """
import asyncio, json, sys, time
from ldcnd.net.zenoh_settings import ZenohSettings
from ldcnd.net.zenoh_session import open_zenoh_session

async def main():
    async with open_zenoh_session(ZenohSettings(mode="client", connect=(sys.argv[1],))) as session:
        times = {key: [] for key in sys.argv[3:]}
        for _ in range(int(sys.argv[2])):
            for key, taken in times.items():
                began_s = time.monotonic()
                answers = await session.query(key, b'{"on": false}', encoding="application/json")
                taken.append((began_s, time.monotonic()))
                assert len(answers) == 1 and not answers[0].is_error, answers
                await asyncio.sleep(0.004)
        print(json.dumps(list(times.values())))

asyncio.run(main())
"""


def rows() -> list[Row]:
    """Measure with a processor that sleeps between commands, and with one that is held awake."""
    found = []
    for awake in (False, True):
        with held_awake(wanted=awake):
            how = ", processor held awake" if awake else ""
            found += [replace(row, name=f"{row.name}{how}") for row in _rows()]
    return found


def _rows() -> list[Row]:
    bare, commands, wire = asyncio.run(_measured())
    bare_us = sorted((end_s - began_s) * 1e6 for began_s, end_s in bare)
    rest_us = sorted(_without_wire_us(commands, wire))
    share_us = [rest - bare_us[len(bare_us) // 2] for rest in rest_us]
    return [
        Row("bare queryable: round trip, median", _quantile(bare_us, 0.5), "us"),
        Row("bare queryable: round trip, 99 %", _quantile(bare_us, 0.99), "us"),
        Row("command without its time on the wire: round trip, median", _quantile(rest_us, 0.5), "us"),
        Row("command without its time on the wire: round trip, 99 %", _quantile(rest_us, 0.99), "us"),
        Row("the daemon's own share, median", _quantile(share_us, 0.5), "us", SHARE_US, at_most=True),
        Row("the daemon's own share, 99 %", _quantile(share_us, 0.99), "us", LATE_SHARE_US, at_most=True),
        Row("99 % of commands less 99 % of bare queries", _quantile(rest_us, 0.99) - _quantile(bare_us, 0.99), "us"),
        Row("command without the wire / bare queryable, medians", _quantile(rest_us, 0.5) / _quantile(bare_us, 0.5)),
    ]


def _rig(port: Path) -> RigConfig:
    """Return a rig with one axis that is hardly polled: waiting for another exchange is not what is measured."""
    rates = {"position": 0.0, "velocity": 0.0, "adc": 0.0, "state": 0.2}
    axis = {"name": "x", "address": 1, "model": "ls-182ap", "velocity": 1.0, "acceleration": 1.0, "rates": rates}
    bus = {"name": "line0", "port": str(port), "baud": 115_200, "stop_probe_hz": 0.0, "axis": [axis]}
    return RigConfig.model_validate({"rig": "bench", "bus": [bus]})


async def _measured() -> tuple[list[tuple[float, float]], list[tuple[float, float]], list[WireRecord]]:
    """Return when each bare query and each command began and ended, and what was on the wire."""
    with tempfile.TemporaryDirectory() as folder:
        port = Path(folder) / "line0"
        async with simulated_terminal(port, "ls182ap"):
            return await _measured_at(port)


async def _measured_at(
    port: Path,
) -> tuple[list[tuple[float, float]], list[tuple[float, float]], list[WireRecord]]:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with open_zenoh_session(ZenohSettings(listen=(endpoint,))) as session, asyncio.TaskGroup() as group:
        await session.serve(BARE, _echo, complete=True)
        daemon = build_daemon(_rig(port), session, time.time_ns, "bench")
        running = group.create_task(daemon.run(), name="daemon")
        await daemon.wait_up()
        await asyncio.sleep(2.0)  # until its drive has answered
        settle_heap()  # as `ldcnd run` does
        client = await asyncio.create_subprocess_exec(
            sys.executable, "-c", CLIENT, endpoint, str(ROUNDS), BARE, "ldcn/bench/@cmd/x/power", stdout=PIPE
        )
        printed, _ = await client.communicate()
        (bus,) = daemon.rig.buses
        wire = bus.bus.wire_log.records()
        daemon.end()
        await running
    bare, commands = json.loads(printed)
    return bare, commands, list(wire)


def _echo(query: Query) -> None:
    query.reply(query.payload, query.encoding)


def _without_wire_us(commands: list[tuple[float, float]], wire: list[WireRecord]) -> list[float]:
    """Return the round trips less the exchange that each of them had, in us."""
    sent = [
        at
        for at, record in enumerate(wire)
        if record.event is WireEvent.SENT and record.data[2:3] and record.data[2] & 0xF == STOP_MOTOR
    ]
    found = []
    for began_s, end_s in commands:
        at = next((at for at in sent if began_s < wire[at].at_s < end_s), None)
        if at is None:
            continue  # so old that the recorder has forgotten it
        received_s = next(record.at_s for record in wire[at:] if record.event is WireEvent.RECEIVED)
        found.append((end_s - began_s - (received_s - wire[at].at_s)) * 1e6)
    return found


def _quantile(values: list[float], share: float) -> float:
    return sorted(values)[min(len(values) - 1, int(share * len(values)))]


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.CRITICAL))
    print(table(rows()))
