"""A program that knows nothing of ldcnd, on a port that ldcnd serves."""

import asyncio
import os
import termios
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from pathlib import Path

from ldcnd.config.rig import RigConfig
from ldcnd.drives.ldcn.packet import CommandCode, Packet, encode_packet
from ldcnd.sim.chain import Chain
from tests.support.machine_rig import Machine, machine, running_machine

SET_ADDRESS = CommandCode.SET_ADDRESS
LOOK_S = 0.0002
"""How often a program looks for more of a reply, seconds."""


def with_port(
    link: Path,
    access: str = "read",
    *,
    fresh_ms: float = 0.0,
    module: dict[str, object] | None = None,
    **axis: object,
) -> RigConfig:
    """Return the machine with a port."""
    document = machine(axis=axis, module=module).model_dump(mode="json", exclude_defaults=True)
    port = {"name": "old", "bus": "line", "link": str(link), "access": access, "idle_s": 5.0, "fresh_ms": fresh_ms}
    return RigConfig.model_validate(document | {"port": [port]})


def set_rate(descriptor: int, rate: int) -> None:
    """Set the rate of a terminal."""
    settings = termios.tcgetattr(descriptor)
    settings[4] = settings[5] = rate
    termios.tcsetattr(descriptor, termios.TCSANOW, settings)


def open_port(link: Path) -> "Program":
    """Open the port as a program does, at the rate after power-up."""
    descriptor = os.open(link, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    set_rate(descriptor, termios.B19200)
    return Program(descriptor)


class Program:
    """The program, with the port open."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor = descriptor

    def close(self) -> None:
        """Close the port, as a program that ends."""
        os.close(self._descriptor)
        self._descriptor = -1

    def send_bytes(self, data: bytes) -> None:
        """Send bytes, and drop what has come until now."""
        with suppress(BlockingIOError):
            os.read(self._descriptor, 4096)
        os.write(self._descriptor, data)

    async def send(self, packet: Packet, within_s: float = 1.0) -> str:
        """Send a packet; return the reply once nothing more comes."""
        self.send_bytes(encode_packet(packet))
        reply, loop = b"", asyncio.get_running_loop()
        until_s = loop.time() + within_s
        while loop.time() < until_s:
            await asyncio.sleep(LOOK_S)
            try:
                reply += os.read(self._descriptor, 100)
            except BlockingIOError:
                if reply:
                    break  # it comes in one piece
        return reply.hex()

    def set_rate(self, rate: int) -> None:
        """Set the rate of the terminal, one of the codes of termios."""
        set_rate(self._descriptor, rate)

    async def change_rate(self) -> None:
        """Change to 115,200 bits/s, as every program does that wants to be quick."""
        await self.send(Packet(0xFF, CommandCode.SET_BAUD_RATE, b"\x0a"), 0.05)
        set_rate(self._descriptor, termios.B115200)

    async def begin(self) -> None:
        """Do as every program does: reset the line and give addresses."""
        await self.send(Packet(0xFF, CommandCode.HARD_RESET), 0.05)
        for address in (1, 2, 3):
            assert await self.send(Packet(0, SET_ADDRESS, bytes((address, 0xFF))))


@asynccontextmanager
async def guest(
    tmp_path: Path, access: str = "read", *, fresh_ms: float = 0.0, chain: Chain | None = None, **axis: object
) -> AsyncIterator[tuple[Machine, Program]]:
    """Run the machine, and a program with its port open."""
    config = with_port(tmp_path / "port", access, fresh_ms=fresh_ms, module=None, **axis)
    async with running_machine(config, chain) as rig:
        program = open_port(tmp_path / "port")
        try:
            yield rig, program
        finally:
            with suppress(OSError):
                program.close()
