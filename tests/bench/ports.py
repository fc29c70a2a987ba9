"""What a program on a port that asks as fast as it can leaves to others, on the jumping clock."""

import asyncio
import tempfile
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from ldcnd.config.plan import plan_rig
from ldcnd.config.rig import RigConfig
from ldcnd.contract.errors import LdcndError
from ldcnd.drives.ldcn.packet import CommandCode, Packet
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Lane
from tests.bench.report import Row
from tests.bench.saturated_rig import on_jumping_clock, saturating, saturating_smartsteps
from tests.support.guest_program import open_port
from tests.support.rig import RunningRig
from tests.support.units_program import UnitsProgram

LEAST_SHARE = 0.7
"""Of the polls of others without the program."""
PAID_S = {"8 drives": 1.0, "2 SmartSteps": 40.0}
"""By then a program has used what it has for nothing, seconds."""
PROBE_PERIOD_S = 0.1
Program = Callable[[], Awaitable[object]]
"""Asks once, and returns when the reply has come."""


@dataclass(frozen=True, slots=True)
class Left:
    """What is left to others.

    Attributes:
        polls_per_s: good polls.
        stop_wait_s: the longest wait of a stop for the line.
    """

    polls_per_s: float
    stop_wait_s: float


def rows(seconds: float) -> list[Row]:
    """Measure for so many virtual seconds each."""
    lines = {"8 drives": (saturating(8), _servo), "2 SmartSteps": (saturating_smartsteps(), _units)}
    return [row for name, (config, program) in lines.items() for row in _rows(name, config, program, seconds)]


def _rows(name: str, config: RigConfig, open_program: Callable[[Path], Program], seconds: float) -> list[Row]:
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "port"
        port = {"name": "old", "bus": config.bus[0].name, "link": str(link)}
        document = config.model_dump(mode="json", exclude_defaults=True) | {"port": [port]}
        ported = RigConfig.model_validate(document)
        bound_s = max(bus.stop_wait_s for bus in plan_rig(ported).buses)
        alone, beside = on_jumping_clock(ported, lambda rig: _compared(rig, link, open_program, PAID_S[name], seconds))
    what = f"a program that asks without a pause, {name}"
    share = beside.polls_per_s / alone.polls_per_s
    return [
        Row(f"{what}: polls of others / without", share, "", LEAST_SHARE, exact=True),
        Row(f"{what}: longest wait of a stop without", alone.stop_wait_s * 1e3, "ms", exact=True),
        Row(f"{what}: longest wait of a stop", beside.stop_wait_s * 1e3, "ms", bound_s * 1e3, at_most=True, exact=True),
    ]


async def _compared(
    rig: RunningRig, link: Path, open_program: Callable[[Path], Program], paid_s: float, seconds: float
) -> tuple[Left, Left]:
    bus = rig.daemon.rig.buses[0].bus
    alone = await _left(bus, seconds)
    ask = open_program(link)
    async with asyncio.TaskGroup() as group:
        asking = group.create_task(_without_pause(ask))
        await asyncio.sleep(paid_s)
        beside = await _left(bus, seconds)
        asking.cancel()
    return alone, beside


async def _without_pause(ask: Program) -> None:
    while True:
        assert await ask(), "no reply"


async def _left(bus: Bus, seconds: float) -> Left:
    """Count polls, and probe how long a stop would wait."""
    loop = asyncio.get_running_loop()
    until_s = loop.time() + seconds
    polls, waits = bus.statistics.latency[Lane.POLL], bus.statistics.stop_wait
    before, waits.longest_s = sum(polls.counts), 0.0
    while loop.time() < until_s:
        await asyncio.sleep(PROBE_PERIOD_S)
        with suppress(LdcndError):
            await bus.probe_stop_wait()
    return Left((sum(polls.counts) - before) / seconds, waits.longest_s)


def _servo(link: Path) -> Program:
    """Open a port of an LDCN line; the program gives its addresses with its first question."""
    program, begun = open_port(link), False

    async def ask() -> object:
        nonlocal begun
        if not begun:
            begun = True
            await program.send(Packet(0xFF, CommandCode.HARD_RESET), 0.05)
            await program.send(Packet(0, CommandCode.SET_ADDRESS, b"\x01\xff"))
            await program.change_rate()
        return await program.send(Packet(1, CommandCode.NO_OPERATION))

    return ask


def _units(link: Path) -> Program:
    program = UnitsProgram(str(link))
    return lambda: program.send("W1011000000")
