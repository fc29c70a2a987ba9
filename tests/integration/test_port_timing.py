"""When a reply comes through a port, beside the bare line."""

import asyncio

import pytest

from ldcnd.drives.ldcn.packet import CommandCode, Packet, encode_packet
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.guest_program import Program, guest

READ = Packet(1, CommandCode.READ_STATUS, b"\x01")
SAMPLES = 100


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
