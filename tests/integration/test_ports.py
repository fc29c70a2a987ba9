"""A program that knows nothing of ldcnd reads and stops drives on a port while clients move them."""

import asyncio
import os
import termios
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import MoveVelocity, Power
from ldcnd.contract.events import ReadEvents
from ldcnd.drives.ldcn.packet import CommandCode, Packet, encode_packet
from ldcnd.sim.ldcn.drive import SimulatedDrive
from tests.support.machine_rig import Machine, machine, running_machine

SET_ADDRESS, STOP, NO_OPERATION = CommandCode.SET_ADDRESS, CommandCode.STOP_MOTOR, CommandCode.NO_OPERATION
SMOOTH, OFF = b"\x09", b"\x02"
CHANGES = (
    Packet(1, CommandCode.RESET_POSITION),
    Packet(1, CommandCode.LOAD_TRAJECTORY, bytes((0x97, *(5000).to_bytes(4, "little"), *bytes(8)))),
    Packet(1, CommandCode.START_MOTION),
    Packet(1, CommandCode.SET_GAIN, bytes(14)),
    Packet(1, STOP, b"\x01"),
    Packet(1, STOP, b"\x11" + bytes(4)),
    Packet(1, CommandCode.IO_CONTROL, b"\x00"),
    Packet(1, CommandCode.SET_HOMING_MODE, b"\x02"),
    Packet(1, CommandCode.CLEAR_STICKY_BITS),
    Packet(1, CommandCode.SAVE_CURRENT_POSITION_AS_HOME),
)


def with_port(link: Path, **axis: object) -> RigConfig:
    document = machine(axis=axis).model_dump(mode="json", exclude_defaults=True)
    return RigConfig.model_validate(document | {"port": [{"name": "old", "bus": "line", "link": str(link)}]})


class Program:
    """The program, with the port open."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    async def send(self, packet: Packet, within_s: float = 1.0) -> str:
        """Send a packet; return the reply once nothing more comes."""
        os.write(self._descriptor, encode_packet(packet))
        reply, loop = b"", asyncio.get_running_loop()
        until_s = loop.time() + within_s
        while loop.time() < until_s and len(reply) < 2:
            await asyncio.sleep(0.005)
            try:
                reply += os.read(self._descriptor, 100)
            except BlockingIOError:
                continue
        return reply.hex()

    async def begin(self) -> None:
        """Do as every program does: reset the line and give addresses."""
        await self.send(Packet(0xFF, CommandCode.HARD_RESET), 0.05)
        for address in (1, 2):
            assert await self.send(Packet(0, SET_ADDRESS, bytes((address, 0xFF))))


@asynccontextmanager
async def guest(tmp_path: Path, **axis: object) -> AsyncIterator[tuple[Machine, Program]]:
    async with running_machine(with_port(tmp_path / "port", **axis)) as rig:
        descriptor = os.open(tmp_path / "port", os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        settings = termios.tcgetattr(descriptor)
        settings[4] = settings[5] = termios.B19200
        termios.tcsetattr(descriptor, termios.TCSANOW, settings)
        try:
            yield rig, Program(descriptor)
        finally:
            os.close(descriptor)


def registers(rig: Machine) -> list[tuple[object, ...]]:
    """Return what the simulated drives hold that a guest could change."""
    drives = [each for each in rig.chain.modules if isinstance(each, SimulatedDrive)]
    return [(each.address, each.group, each.leader, each.baud, each.items) for each in drives]


def count_packets(rig: Machine) -> list[int]:
    """Count what is sent on the line from now on."""
    counted, write = [0], rig.chain.write

    def count(now_s: float, data: bytes) -> None:
        counted[0] += 1
        write(now_s, data)

    rig.chain.write = count
    return counted


async def turning(rig: Machine) -> None:
    await rig.client.ask(Power(on=True), "rotor")
    await rig.client.ask(MoveVelocity(velocity=5.0), "rotor")
    async with asyncio.timeout(5.0):
        while rig.speed() < 4.0:
            await asyncio.sleep(0.02)


async def test_a_guest_resets_and_readdresses_and_the_motion_of_others_goes_on(tmp_path):
    async with guest(tmp_path) as (rig, program):
        await turning(rig)
        before = registers(rig)
        await program.begin()

        assert await program.send(Packet(1, NO_OPERATION))
        assert rig.speed() > 4.0
        assert registers(rig) == before


async def test_what_would_move_or_set_a_drive_is_answered_not_done_and_an_event(tmp_path):
    async with guest(tmp_path) as (rig, program):
        await turning(rig)
        await program.begin()

        for packet in CHANGES:
            assert await program.send(packet), packet

        assert rig.speed() > 4.0
        events = (await rig.client.ask(ReadEvents(axis="rotor"))).events
        refused = [event for event in events if event.client == "old"]
        assert {event.status.value for event in refused} == {"refused"}
        assert len(refused) >= 9


@pytest.mark.parametrize("control", [SMOOTH, OFF])
async def test_a_stop_of_a_guest_always_goes_out(tmp_path, control):
    async with guest(tmp_path) as (rig, program):
        await turning(rig)
        await program.begin()

        await program.send(Packet(1, STOP, control))

        async with asyncio.timeout(3.0):
            while rig.speed() > 0.01:
                await asyncio.sleep(0.02)
        assert rig.daemon.rig.axes["rotor"].tracker.status.enabled is (control == SMOOTH)


def test_a_port_of_a_line_that_is_not_there_is_refused():
    document = machine().model_dump(mode="json", exclude_defaults=True)
    with pytest.raises(ValueError, match="port old: there is no bus 'other'; there are: line"):
        RigConfig.model_validate(document | {"port": [{"name": "old", "bus": "other", "link": "x"}]})


async def test_a_guest_that_reads_as_fast_as_it_can_leaves_polls_their_rate(tmp_path):
    async with guest(tmp_path, rates={"position": 400, "velocity": 400, "adc": 0, "state": 20}) as (rig, program):
        loop = asyncio.get_running_loop()
        packets = count_packets(rig)
        await asyncio.sleep(2.0)
        alone = packets[0]
        await program.begin()
        packets[0] = 0
        replies, until_s = 0, loop.time() + 2.0
        while loop.time() < until_s:
            replies += bool(await program.send(Packet(1, NO_OPERATION)))

        assert replies > 20
        assert packets[0] - replies >= 0.7 * alone
