"""A program that knows nothing of ldcnd, on a port of a line of SmartSteps: pyserial on a terminal, frames by hand."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import serial

from ldcnd.config.rig import RigConfig
from ldcnd.drives.smartstep.packet import add_parity, strip_parity
from ldcnd.sim.smartstep.cable import smartstep_chain
from ldcnd.sim.smartstep.unit import SimulatedUnit
from ldcnd.sim.smartstep.variant import SimulatedVariant
from tests.support.rig import RunningRig, running_rig
from tests.support.smartstep_line import simulated

LOOK_S = 0.0005
PATIENCE_S = 3.0


def frame(head: str) -> bytes:
    """Return a frame of its unit, function, address and data, such as `W1010000000`; adds checksum and CR."""
    return f"{head}{-sum(bytes.fromhex(head[1:])) & 0xFF:02X}\r".encode()


class UnitsProgram:
    """The program, with the port open.

    Attributes:
        port: of pyserial.
    """

    def __init__(self, url: str, *, soft_parity: bool = False, baud: int = 9600) -> None:
        self.port = serial.serial_for_url(
            url,
            baud,
            bytesize=serial.EIGHTBITS if soft_parity else serial.SEVENBITS,
            parity=serial.PARITY_NONE if soft_parity else serial.PARITY_EVEN,
            timeout=0,
        )
        self._soft_parity = soft_parity

    async def send_bytes(self, data: bytes, within_s: float = PATIENCE_S) -> str:
        """Send bytes; return what comes back to its CR, without it; empty when nothing comes."""
        self.port.reset_input_buffer()
        self.port.write(add_parity(data) if self._soft_parity else data)
        reply, loop = b"", asyncio.get_running_loop()
        until_s = loop.time() + within_s
        while loop.time() < until_s and not reply.endswith(b"\r"):
            await asyncio.sleep(LOOK_S)
            read = self.port.read(4096)
            reply += strip_parity(read) if self._soft_parity else read
        return reply.decode().rstrip("\r")

    async def send(self, head: str, within_s: float = PATIENCE_S) -> str:
        """Send a frame; return the reply without checksum and CR."""
        reply = await self.send_bytes(frame(head), within_s)
        assert not reply or frame(reply[:11])[:13].decode() == reply or head[2] == "2", reply
        return reply[:11] if head[2] != "2" else reply


def with_units_port(link: Path, access: str = "control", **config: object) -> RigConfig:
    """Return two SmartSteps, `feed` and `spool`, with a port; polled now and then."""
    axes = [
        {"name": name, "address": number, "model": "smartstep", "unit": "rev", "counts_per_unit": 8000}
        | {"rates": {"position": 1, "velocity": 2, "state": 2}}
        for number, name in ((1, "feed"), (2, "spool"))
    ]
    return RigConfig.model_validate(
        {
            "rig": "steps",
            "state_dir": str(link.parent / "state"),
            "sim": [{"name": "steps", "unit": [{"number": 1}, {"number": 2}]}],
            "bus": [{"name": "steps", "port": "sim:steps", "family": "smartstep", "axis": axes}],
            "port": [{"name": "old", "bus": "steps", "link": str(link), "access": access, "idle_s": 5.0}],
        }
        | config
    )


@asynccontextmanager
async def units_guest(
    tmp_path: Path, access: str = "control", variant: SimulatedVariant | None = None
) -> AsyncIterator[tuple[RunningRig, UnitsProgram, SimulatedUnit]]:
    """Run the rig and a program with its port open; yields the first simulated drive, too."""
    feed, spool = (simulated(number, variant) for number in (1, 2))
    config = with_units_port(tmp_path / "port", access)
    async with running_rig(config, {"steps": smartstep_chain([feed, spool])}) as rig:
        for axis in ("feed", "spool"):
            await rig.until(axis, lambda state: state.link == "up")
        program = UnitsProgram(str(tmp_path / "port"))
        try:
            yield rig, program, feed
        finally:
            program.port.close()
