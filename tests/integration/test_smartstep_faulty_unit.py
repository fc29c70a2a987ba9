"""SmartSteps are addressed one by one: one that is silent, or answers nonsense, keeps no other one of its line down."""

import asyncio
import random
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager

import pytest
from typing_extensions import override

from ldcnd.client.traces import take_trace
from ldcnd.config.rig import RigConfig
from ldcnd.contract.samples import LinkState, Quality
from ldcnd.contract.traces import TakeTrace
from ldcnd.drives.smartstep.packet import CommandPacket, Function, ReplyPacket, ResponseStatus, decode_command
from ldcnd.drives.smartstep.parameters import PN000, PN100
from ldcnd.sim.smartstep.cable import smartstep_chain
from ldcnd.sim.smartstep.unit import SimulatedUnit, Transmission
from tests.support.rig import RunningRig, running_rig
from tests.support.smartstep_line import simulated

GOOD = ("a", "b")


class GarblingUnit(SimulatedUnit):
    """A drive whose replies are turned into something else from its start on."""

    def __init__(self, number: int, garbled: Callable[[CommandPacket, bytes], bytes]) -> None:
        super().__init__(None, {PN000: number << 8})
        self._garbled = garbled

    @override
    def _obey(self, packet: bytes, at_s: float) -> None:
        super()._obey(packet, at_s)
        command = decode_command(packet)
        if self._pending and command:
            self._pending = Transmission(self._garbled(command, self._pending.characters), self._pending.start_s)


def _with_status(command: CommandPacket) -> bytes:
    digits = b"%X%X%04X%04X" % (command.unit, 0xC, command.address, command.data)
    total = -sum(bytes.fromhex(digits.decode())) & 0xFF
    return b"W%b%02X\r" % (digits, total)


def _mode_that_stays(command: CommandPacket, reply: bytes) -> bytes:
    """Always in a mode that another host has left, and its writes get no usable answers."""
    if command.function is Function.SETTING:
        return b"?" * 14
    if command.address == 0x2000:
        return ReplyPacket(command.unit, ResponseStatus.REFERENCE, 0x2000, 0x0102).encode()
    return reply


RANDOM = random.Random(20261129)
READS_WELL = "answers to all but settings"
GARBLED = {
    "a checksum that is wrong": lambda _, reply: reply[:11] + bytes([reply[11] ^ 1]) + reply[12:],
    "noise as long as a reply": lambda _, reply: RANDOM.randbytes(len(reply)),
    "noise that does not end": lambda *_: RANDOM.randbytes(300),
    "another answer than the known one": lambda command, _: ReplyPacket(
        command.unit, ResponseStatus.REFERENCE, command.address, 0x1234
    ).encode(),
    "a refusal of everything": lambda command, _: ReplyPacket(
        command.unit, ResponseStatus.REFERENCE_ADDRESS_ERROR, command.address, command.data
    ).encode(),
    "a status that does not exist": lambda command, _: _with_status(command),
    "the address of another word": lambda command, _: ReplyPacket(
        command.unit, ResponseStatus.REFERENCE, command.address ^ 1, 0x1234
    ).encode(),
    "the number of another unit": lambda command, _: ReplyPacket(
        1, ResponseStatus.REFERENCE, command.address, 0x1234
    ).encode(),
    "the first half of a reply": lambda _, reply: reply[:7],
    "its own command": lambda command, _: command.encode(),
    READS_WELL: _mode_that_stays,
}
INTACT = {"another answer than the known one", "a refusal of everything", "its own command"}
"""Packets without a mistake that no drive of this family sends."""


def config(numbers: dict[str, int]) -> RigConfig:
    axes = [
        {"name": name, "address": number, "model": "smartstep", "unit": "mm", "counts_per_unit": 800}
        for name, number in numbers.items()
    ]
    line = {"name": "steps", "port": "sim:steps", "family": "smartstep", "axis": axes}
    sim = {"name": "steps", "unit": [{"number": number} for number in numbers.values()]}
    return RigConfig.model_validate({"rig": "bench", "bus": [line], "sim": [sim]})


@asynccontextmanager
async def three(
    numbers: dict[str, int], garbled: Callable[[CommandPacket, bytes], bytes], *more: SimulatedUnit
) -> AsyncIterator[RunningRig]:
    """Run a line with two good units, one that is not there unless it is given, and one that garbles."""
    units = [simulated(numbers["a"]), GarblingUnit(numbers["garbling"], garbled), simulated(numbers["b"]), *more]
    async with running_rig(config(numbers), chains={"steps": smartstep_chain(units)}) as rig:
        yield rig


async def problem_of(rig: RunningRig, axis: str) -> str:
    """Return the fault that stands of an axis which does not answer as it must."""
    state, faults = await rig.client.state(axis), await rig.client.last(axis, "fault")
    assert state.link is LinkState.DOWN
    (fault,) = faults.active
    return fault.code


@pytest.mark.parametrize("garbled", GARBLED)
@pytest.mark.parametrize("order", [(1, 2, 3, 4), (2, 4, 1, 3)], ids=["faulty last", "faulty first"])
@pytest.mark.sweep(2)
async def test_a_silent_unit_and_a_garbling_one_keep_no_other_from_reading_and_tracing(garbled, order):
    numbers = dict(zip((*GOOD, "silent", "garbling"), order, strict=True))
    async with three(numbers, GARBLED[garbled]) as rig:
        await rig.until("a", lambda state: state.link is LinkState.UP, within_s=30.0)
        await asyncio.sleep(20.0)

        assert await problem_of(rig, "silent") == "link_lost"
        (line,) = await rig.client.buses()
        remarks = {name: [each for each in line.remarks if f"(axis {name})" in each] for name in numbers}
        assert [len(remarks[name]) for name in numbers] == [0, 0, 1, 1]
        if garbled != READS_WELL:
            expected = "not_identified" if garbled in INTACT else "link_lost"
            assert await problem_of(rig, "garbling") == expected
        for name in GOOD:
            before = await rig.client.last(name, "position")
            trace = await take_trace(
                rig.client, name, TakeTrace(channels=("speed_feedback", "inp"), interval_s=0.002), 120.0
            )
            assert len(trace.values[0]) == trace.header.samples
            now = await rig.client.last(name, "position")
            assert (now.quality, now.seq > before.seq) == (Quality.GOOD, True)


@pytest.mark.parametrize("garbled", ["noise as long as a reply", "another answer than the known one"])
async def test_faulty_units_are_served_once_they_answer(garbled):
    numbers = {"a": 1, "b": 2, "silent": 3, "garbling": 4}
    silent, mended = simulated(3), asyncio.Event()
    silent.power_off(0.0)

    def garbles(command: CommandPacket, reply: bytes) -> bytes:
        return reply if mended.is_set() else GARBLED[garbled](command, reply)

    async with three(numbers, garbles, silent) as rig:
        await asyncio.sleep(20.0)
        assert {await problem_of(rig, name) for name in ("silent", "garbling")} <= {"link_lost", "not_identified"}
        mended.set()
        silent.power_on(asyncio.get_running_loop().time())
        for name in numbers:
            await rig.until(name, lambda state: state.link is LinkState.UP, within_s=15.0)
            assert (await rig.client.last(name, "fault")).active == ()
            assert (await rig.client.last(name, "position")).quality is Quality.GOOD


async def test_a_line_that_is_lost_and_open_again_while_a_unit_is_asked_again_is_polled_as_before():
    """The search sleeps once the unit has answered, and so heard of no loss: nobody polled the others any more."""
    numbers, mended, lost = {"a": 1, "b": 2, "garbling": 4}, asyncio.Event(), asyncio.Event()
    loop = asyncio.get_running_loop()

    def garbles(command: CommandPacket, reply: bytes) -> bytes:
        if not mended.is_set():
            return GARBLED["another answer than the known one"](command, reply)
        if command.address == PN100.ram_address and not lost.is_set():
            lost.set()
            loop.call_later(0.05, rig.daemon.rig.lines["steps"].bus.drop, "an adapter that comes and goes")
        return reply

    async with three(numbers, garbles) as rig:
        await rig.until("a", lambda state: state.link is LinkState.UP, within_s=30.0)
        mended.set()
        await asyncio.wait_for(lost.wait(), 30.0)
        await rig.until("a", lambda state: state.link is LinkState.DOWN, within_s=2.0)
        for name in numbers:
            await rig.until(name, lambda state: state.link is LinkState.UP, within_s=15.0)
            before = await rig.client.last(name, "position")
            await asyncio.sleep(2.0)
            now = await rig.client.last(name, "position")
            assert (now.quality, now.seq > before.seq) == (Quality.GOOD, True)
