"""Every command of the manuals by a program on a port, reply by reply beside the bare simulated line.

A row is equal to the last byte, or says why it is not. Sources: PIC-SERVO manual, 5.2; PIC-I/O data sheet.
"""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import dataclass

import pytest

from ldcnd.drives.ldcn.packet import CommandCode, Packet, encode_packet
from ldcnd.drives.ldcn.profiles import PIC_SERVO_SC
from ldcnd.drives.ldcn.trajectory import programmed_acceleration, programmed_velocity
from tests.support.guest_program import guest
from tests.support.machine_rig import COUNTS, GAINS, chain_of_machine

GIVES_ADDRESSES = tuple(Packet(0, CommandCode.SET_ADDRESS, bytes((address, 0xFF))) for address in (1, 2, 3))
SERVO, IO = 1, 3
CLEARED = "power on clears the position error first"
OFF = "the motor is off, which the drive calls a position error; on the wire this packet leaves its loop closed"


@dataclass(frozen=True)
class Row:
    """A packet of the program.

    Attributes:
        then_s: how long the program waits before its next one.
        differs: why the reply is another one than on the bare line; empty where it is the same.
    """

    command: str
    packet: Packet
    then_s: float = 0.2
    differs: str = ""


def loaded(control: int, *, counts: int | None = None, speed: float = 5.0) -> Packet:
    data = bytes((control,)) + (b"" if counts is None else counts.to_bytes(4, "little", signed=True))
    data += programmed_velocity(speed * COUNTS, 1, PIC_SERVO_SC).to_bytes(4, "little")
    data += programmed_acceleration(20 * COUNTS, 1, PIC_SERVO_SC).to_bytes(4, "little")
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
ROWS = (
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
    Row("Load Trajectory, for later", loaded(0x17, counts=500)),
    Row("No Operation before the start", NOP),
    Row("Start Motion", servo(CommandCode.START_MOTION)),
    Row("No Operation in motion", NOP, then_s=3),
    Row("No Operation after it", NOP),
    Row("Load Trajectory, at once", loaded(0x97, counts=1500), then_s=3),
    Row("Load Trajectory, a velocity", loaded(0xB6, speed=1.0)),
    Row("No Operation at a velocity", NOP),
    Row("Stop Motor, smoothly", servo(CommandCode.STOP_MOTOR, 0x09), then_s=3),
    Row("Stop Motor, abruptly", servo(CommandCode.STOP_MOTOR, 0x05)),
    Row("Set Homing Mode", servo(CommandCode.SET_HOMING_MODE, 0x28)),
    Row("Load Trajectory, the search", loaded(0xB6, speed=0.5)),
    Row("No Operation in the search", NOP, then_s=6),
    Row("No Operation after it", NOP),
    Row("Reset Position to the home position", servo(CommandCode.RESET_POSITION, 1)),
    Row("Save Current Position as Home", servo(CommandCode.SAVE_CURRENT_POSITION_AS_HOME)),
    Row("I/O Control", servo(CommandCode.IO_CONTROL, 0)),
    Row("Add Path Points", servo(CommandCode.ADD_PATH_POINTS, 0, 0, 0, 0)),
    Row("Stop Motor, here", servo(CommandCode.STOP_MOTOR, 0x11, 0, 0, 0, 0)),
    Row("Stop Motor, amplifier off", servo(CommandCode.STOP_MOTOR, 0x00), differs=OFF),
    Row("Stop Motor, motor off", servo(CommandCode.STOP_MOTOR, 0x02)),
    Row("PIC-I/O: Define Status, nothing", io(CommandCode.DEFINE_STATUS, 0)),
    Row("PIC-I/O: Read Status, everything", io(CommandCode.READ_STATUS, 0xFF)),
    Row("PIC-I/O: Set I/O Direction", io(CommandCode.RESET_POSITION, 0xFF, 0x0D)),
    Row("PIC-I/O: Set Output", io(CommandCode.SET_GAIN, 0, 2)),
    Row("PIC-I/O: Read Status, inputs", io(CommandCode.READ_STATUS, 1)),
    Row("PIC-I/O: Set PWM", io(CommandCode.LOAD_TRAJECTORY, 0, 0)),
    Row("PIC-I/O: Set Timer Mode", io(CommandCode.IO_CONTROL, 0)),
    Row("PIC-I/O: No Operation", io(CommandCode.NO_OPERATION)),
    Row("Set Baud Rate", Packet(0xFF, CommandCode.SET_BAUD_RATE, b"\x3f")),
    Row("No Operation after it", NOP),
)


async def said(send: Callable[[Packet], Awaitable[str]]) -> list[str]:
    """Return the reply to each packet."""
    await send(Packet(0xFF, CommandCode.HARD_RESET))
    await asyncio.sleep(0.1)
    replies = [await send(packet) for packet in GIVES_ADDRESSES]
    for row in ROWS:
        replies.append(await send(row.packet))
        await asyncio.sleep(row.then_s)
    return replies


@pytest.mark.long
async def test_replies_are_those_of_the_bare_line_or_it_is_said_why_not(tmp_path):
    chain, loop = chain_of_machine(), asyncio.get_running_loop()

    async def on_line(packet: Packet) -> str:
        chain.write(loop.time(), encode_packet(packet))
        await asyncio.sleep(0.06)
        return b"".join(piece for _, piece in chain.advance(loop.time())).hex()

    bare = await said(on_line)
    async with guest(tmp_path, "control") as (_, program):
        through_port = await said(lambda packet: program.send(packet, 0.3))

    assert through_port[:3] == bare[:3]
    for row, here, there in zip(ROWS, through_port[3:], bare[3:], strict=True):
        print(f"{row.command:45} {here:40} {there:40} {row.differs}")
        assert (here != there) is bool(row.differs), f"{row.command}: {here}, and {there} on the bare line"
