"""Jog an axis by a joystick or gamepad: `jog_by_joystick.py DEVICE [ENDPOINT [AXIS]]`, such as /dev/input/js0.

The stick sets the speed in four steps, while button 0 is held: letting go of either ends the jog, and so does a device
that is unplugged, or one that has said nothing for HOLD_S: a stick in a hand is never quite still, and a wireless one
that has lost its radio falls silent. Then the button must be pressed anew. Every renewal is sent because both are still
there, so a program that hangs ends it, too.
"""

import asyncio
import struct
import sys
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import ldcnd

EVENT = struct.Struct("=IhBB")  # time in ms, value, type, number: linux/joystick.h
BUTTON, STICK, INITIAL = 0x01, 0x02, 0x80
FULL = 32767
STEPS = 4
FASTEST = 8.0  # units a second
HOLD_S = 0.5  # longest silence of the device, and longest time between two renewals


class Joystick:
    """What the hand does: the position of stick 0 and whether button 0 is pressed."""

    def __init__(self) -> None:
        self.pressed = False
        self.stick = 0
        self.moved = asyncio.Event()

    async def read(self, device: BinaryIO) -> None:
        """Follow a device until it is gone."""
        loop = asyncio.get_running_loop()
        reader = asyncio.StreamReader()
        await loop.connect_read_pipe(lambda: asyncio.StreamReaderProtocol(reader), device)
        with suppress(asyncio.IncompleteReadError, OSError):
            while True:
                silence = loop.call_later(HOLD_S, self.let_go)
                try:
                    _, value, kind, number = EVENT.unpack(await reader.readexactly(EVENT.size))
                finally:
                    silence.cancel()
                if number == 0 and kind == BUTTON:  # not what the kernel says when the device is opened: INITIAL
                    self.pressed = bool(value)
                elif number == 0 and kind & ~INITIAL == STICK:
                    self.stick = value
                self.moved.set()
        self.let_go()

    def let_go(self) -> None:
        """Take the button for released."""
        self.pressed = False
        self.moved.set()

    @property
    def velocity(self) -> float:
        """What the hand asks for; 0 for rest."""
        return round(self.stick / FULL * STEPS) / STEPS * FASTEST if self.pressed else 0.0


async def main(device: BinaryIO, endpoint: str | None = None, axis: str = "x") -> None:
    """Jog until the device is gone."""
    hand = Joystick()
    async with ldcnd.connect(endpoint) as rig, rig.control(axis, client="joystick") as x:
        await x.power(on=True)
        reading = asyncio.create_task(hand.read(device))
        while not reading.done():
            if not hand.velocity:
                hand.moved.clear()
                await hand.moved.wait()
                continue
            try:
                async with x.jogging(hand.velocity, hold_s=HOLD_S) as jog:
                    print("jogs", flush=True)
                    while hand.velocity:
                        await jog.held(hand.velocity)
            except ldcnd.LdcndError as error:
                print(error.code, error.message)
                await asyncio.sleep(0.5)
            print(f"halted at {float(x.position):.1f}", flush=True)


with Path(sys.argv[1]).open("rb", buffering=0) as opened:
    asyncio.run(main(opened, *sys.argv[2:]))
