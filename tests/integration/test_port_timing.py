"""When a reply comes through a port, beside the bare line."""

import asyncio
from dataclasses import dataclass
from typing import Any

import pytest

from ldcnd.drives.ldcn.packet import CommandCode, Packet, encode_packet
from ldcnd.line.exchange import Exchange, Timing
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.guest_program import LOOK_S, Program, guest
from tests.support.machine_rig import Machine

READ = Packet(1, CommandCode.READ_STATUS, b"\x01")
SAMPLES = 100
BYTE_S = 10 / 115_200


async def delay_s(program: Program, pause_s: float) -> float:
    """Return how long a program waits for a reply, after a pause."""
    await asyncio.sleep(pause_s)
    loop = asyncio.get_running_loop()
    asked_s = loop.time()
    assert await program.send(READ, 0.2)
    return loop.time() - asked_s


async def bare_s() -> float:
    """Return how long the bare line takes for it, at 115,200 bits/s."""
    chain, loop = build_chain(ChainSpec((ModuleSpec("pic-servo-sc"),))), asyncio.get_running_loop()
    for packet in (Packet(0, CommandCode.SET_ADDRESS, b"\x01\xff"), Packet(0xFF, CommandCode.SET_BAUD_RATE, b"\x0a")):
        chain.write(loop.time(), encode_packet(packet))
        await asyncio.sleep(0.05)
        chain.advance(loop.time())
    chain.baud = 115_200
    asked_s = loop.time()
    chain.write(asked_s, encode_packet(READ))
    while not chain.advance(loop.time()):
        await asyncio.sleep(0.0001)
    return loop.time() - asked_s


@dataclass(frozen=True, slots=True)
class Spent:
    """Where the time of a program went until its reply was there, in seconds.

    Attributes:
        before: from when the last bit of its packet has left it until the packet is on the drives' line.
        line: the exchange there, first bit to last.
        after: from then until the reply begins at the program.
    """

    before: float
    line: float
    after: float


async def spent(rig: Machine, program: Program, pause_s: float) -> Spent:
    """Read once, after a pause."""
    timings: list[Timing] = []

    def heard(exchange: Exchange[Any], _reply: bytes, timing: Timing) -> None:
        if exchange.request == encode_packet(READ):
            timings.append(timing)

    await asyncio.sleep(pause_s)
    loop, bus = asyncio.get_running_loop(), rig.daemon.rig.buses[0].bus
    bus.listeners.append(heard)
    asked_s = loop.time()
    reply = bytes.fromhex(await program.send(READ, 0.2))
    replied_s = loop.time()
    bus.listeners.remove(heard)
    (timing,) = timings
    left_s = asked_s + len(encode_packet(READ)) * BYTE_S
    begins_s = replied_s - len(reply) * BYTE_S  # it is written when its last byte would be there
    return Spent(timing.sent_at_s - left_s, timing.received_at_s - timing.sent_at_s, begins_s - timing.received_at_s)


async def test_a_port_adds_nothing_of_its_own_to_the_exchange_on_the_line_and_the_wait_for_it(tmp_path):
    async with guest(tmp_path) as (rig, program):
        await program.begin()
        await program.change_rate()
        found = [await spent(rig, program, 0.02 + 0.0007 * (each % 30)) for each in range(SAMPLES)]
    before, line, after = (sorted(getattr(each, name) for each in found) for name in ("before", "line", "after"))
    for name, of in (("before", before), ("line", line), ("after", after)):
        print(f"{name}: {of[0] * 1000:.3f} {of[SAMPLES // 2] * 1000:.3f} {of[-1] * 1000:.3f} ms")
    assert before[0] < 0.00001  # nothing but the line is waited for
    assert before[SAMPLES // 2] < 0.0005
    assert before[-1] < 0.0025  # at most one exchange of others
    assert line[-1] < 0.0015
    assert after[-1] < 2.1 * LOOK_S  # what the program takes to see that nothing more comes


@pytest.mark.long
async def test_a_reply_comes_one_exchange_of_others_later_than_on_the_bare_line(tmp_path):
    """1.7 ms later in the median and 3.3 ms at most, when a line at 115,200 bits/s polls two axes."""
    async with guest(tmp_path) as (_, program):
        await program.begin()
        await program.change_rate()
        bare = await bare_s()
        with_pauses = sorted([await delay_s(program, 0.02 + 0.0007 * (each % 30)) for each in range(SAMPLES)])
        without = sorted([await delay_s(program, 0.0) for _ in range(SAMPLES)])

    assert with_pauses[SAMPLES // 2] - bare < 0.002
    assert with_pauses[-1] - bare < 0.004
    assert without[SAMPLES // 2] - bare < 0.003
