"""Every command of the manuals by a program on a port, reply by reply beside the bare simulated line.

A row is equal to the last byte, or says why it is not; where a shaft has moved, positions are equal but for a few
counts. Sources: PIC-SERVO manual, 5.2; LS-182AP manual, the sections of the commands; PIC-I/O data sheet.
"""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial

import pytest

from ldcnd.drives.ldcn.packet import CommandCode, Packet, StatusItem, decode_status, encode_packet
from ldcnd.drives.ldcn.profiles import LS_182AP, PIC_SERVO_SC, Profile
from ldcnd.drives.ldcn.trajectory import programmed_acceleration, programmed_velocity
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.guest_program import open_port, with_port
from tests.support.machine_rig import COUNTS, ENDLESS, GAINS, running_machine

GIVES_ADDRESSES = tuple(Packet(0, CommandCode.SET_ADDRESS, bytes((address, 0xFF))) for address in (1, 2, 3))
SERVO, IO = 1, 3
CLEARED = "power on clears the position error first"
OFF = "the motor is off, which the drive calls a position error; on the wire this packet leaves its loop closed"


NOTHING = StatusItem(0)


@dataclass(frozen=True)
class Row:
    """A packet of the program.

    Attributes:
        then_s: how long the program waits before its next one.
        differs: why the reply is another one than on the bare line; empty where it is the same.
        differs_on: the model for which it does; empty for every one.
        items: what the reply holds besides the status byte, of which counts are only nearly equal.
    """

    command: str
    packet: Packet
    then_s: float = 0.2
    differs: str = ""
    differs_on: str = ""
    items: StatusItem = NOTHING


PACE_S = 0.35
NEAR = 30
"""Counts by which positions may differ: a shaft at rest hunts, and an edge is seen a servo cycle earlier or later."""


def loaded(control: int, *, counts: int | None = None, speed: float = 5.0, profile: Profile = PIC_SERVO_SC) -> Packet:
    data = bytes((control,)) + (b"" if counts is None else counts.to_bytes(4, "little", signed=True))
    data += programmed_velocity(speed * COUNTS, 1, profile).to_bytes(4, "little")
    data += programmed_acceleration(20 * COUNTS, 1, profile).to_bytes(4, "little")
    return Packet(SERVO, CommandCode.LOAD_TRAJECTORY, data)


def servo(command: CommandCode, *data: int) -> Packet:
    return Packet(SERVO, command, bytes(data))


def io(command: CommandCode, *data: int) -> Packet:
    return Packet(IO, command, bytes(data))


GAIN_BYTES = (
    *b"".join(GAINS[name].to_bytes(2, "little") for name in ("kp", "kd", "ki", "il")),
    *(GAINS["ol"], 0, *GAINS["el"].to_bytes(2, "little"), 1, 0, 1),
)
NOP = servo(CommandCode.NO_OPERATION)
HOME = StatusItem.HOME
PLACE = StatusItem.POSITION | HOME


def places(when: str) -> Row:
    return Row(f"Read Status, position and home, {when}", servo(CommandCode.READ_STATUS, int(PLACE)), items=PLACE)


def rows(profile: Profile) -> tuple[Row, ...]:
    load = partial(loaded, profile=profile)
    return (
        Row("Define Status, nothing", servo(CommandCode.DEFINE_STATUS, 0)),
        Row("Read Status, everything", servo(CommandCode.READ_STATUS, 0xFF)),
        Row("Define Status, position", servo(CommandCode.DEFINE_STATUS, 1)),
        Row("Define Status, nothing", servo(CommandCode.DEFINE_STATUS, 0)),
        Row("No Operation", NOP),
        Row("Set Address, with a group", servo(CommandCode.SET_ADDRESS, 1, 0x81)),
        Row("No Operation of a group without a leader", Packet(0x81, CommandCode.NO_OPERATION)),
        Row("Set Address, as leader", servo(CommandCode.SET_ADDRESS, 1, 0x01)),
        Row("No Operation of a group with its leader", Packet(0x81, CommandCode.NO_OPERATION)),
        Row("No Operation of nobody", Packet(9, CommandCode.NO_OPERATION)),
        Row("Set Gain", servo(CommandCode.SET_GAIN, *GAIN_BYTES)),
        Row("Stop Motor, amplifier on", servo(CommandCode.STOP_MOTOR, 0x05), differs=CLEARED),
        Row("Clear Sticky Bits", servo(CommandCode.CLEAR_STICKY_BITS)),
        Row("Reset Position", servo(CommandCode.RESET_POSITION)),
        Row("Load Trajectory, for later", load(0x17, counts=500)),
        Row("No Operation before the start", NOP),
        Row("Start Motion", servo(CommandCode.START_MOTION)),
        Row("No Operation in motion", NOP, then_s=3),
        Row("No Operation after it", NOP),
        Row("Load Trajectory, at once", load(0x97, counts=1500), then_s=3),
        Row("Load Trajectory, a velocity", load(0xB6, speed=1.0)),
        Row("No Operation at a velocity", NOP),
        Row("Stop Motor, smoothly", servo(CommandCode.STOP_MOTOR, 0x09), then_s=3),
        Row("Stop Motor, abruptly", servo(CommandCode.STOP_MOTOR, 0x05)),
        places("away from zero"),
        Row("Set Homing Mode", servo(CommandCode.SET_HOMING_MODE, 0x28)),
        Row("Load Trajectory, the search", load(0xB6, speed=0.5)),
        Row("No Operation in the search", NOP, then_s=6),
        Row("No Operation after it", NOP),
        places("after the search"),
        Row("Reset Position to the home position", servo(CommandCode.RESET_POSITION, 1)),
        places("after Reset Position"),
        Row("Reset Position, away from home", servo(CommandCode.RESET_POSITION)),
        Row("Set Homing Mode, once more", servo(CommandCode.SET_HOMING_MODE, 0x28)),
        Row("Load Trajectory, the second search", load(0xB6, speed=0.5)),
        Row("Read Status, home, in the search", servo(CommandCode.READ_STATUS, int(HOME)), items=HOME, then_s=6),
        places("after the second search"),
        Row("Save Current Position as Home", servo(CommandCode.SAVE_CURRENT_POSITION_AS_HOME)),
        Row("I/O Control", servo(CommandCode.IO_CONTROL, 0)),
        Row("Add Path Points", servo(CommandCode.ADD_PATH_POINTS, 0, 0, 0, 0)),
        Row("Stop Motor, here", servo(CommandCode.STOP_MOTOR, 0x11, 0, 0, 0, 0)),
        Row("Stop Motor, amplifier off", servo(CommandCode.STOP_MOTOR, 0x00), differs=OFF, differs_on="pic-servo-sc"),
        Row("Stop Motor, motor off", servo(CommandCode.STOP_MOTOR, 0x02)),
        Row("PIC-I/O: Define Status, nothing", io(CommandCode.DEFINE_STATUS, 0)),
        Row("PIC-I/O: Read Status, everything", io(CommandCode.READ_STATUS, 0xFF)),
        Row("PIC-I/O: Set I/O Direction", io(CommandCode.RESET_POSITION, 0xFF, 0x0D)),
        Row("PIC-I/O: Set Output", io(CommandCode.SET_GAIN, 0, 2)),
        Row("PIC-I/O: Read Status, inputs", io(CommandCode.READ_STATUS, 1)),
        Row("PIC-I/O: Set PWM", io(CommandCode.LOAD_TRAJECTORY, 0, 0)),
        Row("PIC-I/O: Set Timer Mode", io(CommandCode.IO_CONTROL, 0)),
        Row("PIC-I/O: Synch Input", io(CommandCode.SAVE_CURRENT_POSITION_AS_HOME)),
        Row("PIC-I/O: Read Status, what was captured", io(CommandCode.READ_STATUS, 0xC0)),
        Row("PIC-I/O: No Operation", io(CommandCode.NO_OPERATION)),
        Row("Set Baud Rate", Packet(0xFF, CommandCode.SET_BAUD_RATE, b"\x3f")),
        Row("No Operation after it", NOP),
    )


async def said(rows: tuple[Row, ...], send: Callable[[Packet], Awaitable[str]]) -> list[str]:
    """Return the reply to each packet."""
    await send(Packet(0xFF, CommandCode.HARD_RESET))
    await asyncio.sleep(0.1)
    replies = [await send(packet) for packet in GIVES_ADDRESSES]
    loop = asyncio.get_running_loop()
    next_s = loop.time()
    for row in rows:
        replies.append(await send(row.packet))
        next_s += PACE_S + row.then_s  # however soon its reply comes
        await asyncio.sleep(next_s - loop.time())
    return replies


def chain_of(profile: Profile) -> Chain:
    return build_chain(
        ChainSpec((ModuleSpec(profile.name, plant=ENDLESS), ModuleSpec(profile.name), ModuleSpec("pic-io")))
    )


def equal(profile: Profile, items: StatusItem, here: str, there: str) -> bool:
    if not items or not (here and there):
        return here == there
    one, other = (decode_status(profile, items, bytes.fromhex(each)) for each in (here, there))
    near = all(abs((a or 0) - (b or 0)) <= NEAR for a, b in ((one.position, other.position), (one.home, other.home)))
    return near and one.flags == other.flags


@pytest.mark.long
@pytest.mark.parametrize("profile", [PIC_SERVO_SC, LS_182AP], ids=lambda each: each.name)
async def test_replies_are_those_of_the_bare_line_or_it_is_said_why_not(tmp_path, profile):
    chain, loop, wanted = chain_of(profile), asyncio.get_running_loop(), rows(profile)

    async def on_line(packet: Packet) -> str:
        chain.write(loop.time(), encode_packet(packet))
        await asyncio.sleep(0.06)
        return b"".join(piece for _, piece in chain.advance(loop.time())).hex()

    bare = await said(wanted, on_line)
    config = with_port(tmp_path / "port", "control", model=profile.name)
    async with running_machine(config, chain_of(profile)):
        program = open_port(tmp_path / "port")
        through_port = await said(wanted, lambda packet: program.send(packet, 0.3))
        program.close()

    assert through_port[:3] == bare[:3]
    others = []
    for row, here, there in zip(wanted, through_port[3:], bare[3:], strict=True):
        differs = row.differs if row.differs_on in ("", profile.name) else ""
        print(f"{row.command:45} {here:40} {there:40} {differs}")
        if equal(profile, row.items, here, there) is bool(differs):
            others.append(f"{row.command}: {here}, and {there} on the bare line")
    assert not others
