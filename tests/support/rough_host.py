"""What hosts in the field do to a chain, as raw frames: none of it is an error, some of it is not polite."""

import asyncio
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from typing_extensions import override

from ldcnd.line.transport import Receiver
from ldcnd.sim.chain import Chain
from ldcnd.sim.line import SimulatedLine, open_simulated_line

HARD_RESET = bytes.fromhex("aa ff 0f 0e")
BAUD_CODES = {9600: 0x81, 19_200: 0x3F, 57_600: 0x14, 115_200: 0x0A}


@dataclass(frozen=True, slots=True)
class Deed:
    """Something a host does.

    Attributes:
        data: what it sends,
        baud: at which rate,
        pause_s: and how long it is silent afterwards.
    """

    data: bytes
    baud: int = 19_200
    pause_s: float = 0.005


def frame(address: int, command: int, *data: int) -> bytes:
    """Return a frame with its checksum."""
    body = bytes([address, len(data) << 4 | command, *data])
    return b"\xaa" + body + bytes([sum(body) & 0xFF])


def enumeration(modules: int, baud: int = 19_200) -> tuple[Deed, ...]:
    """Address the modules 1, 2, ... in group FF, and ask each who it is."""
    return tuple(
        Deed(data, baud)
        for address in range(1, modules + 1)
        for data in (frame(0, 0x1, address, 0xFF), frame(address, 0x3, 0x20))
    )


def hard_reset(pause_s: float, baud: int = 19_200) -> tuple[Deed, ...]:
    """Reset everybody, then wait as long as this host thinks is enough."""
    return (Deed(HARD_RESET, baud, pause_s),)


def padded(frames: Iterable[bytes], nulls: int) -> tuple[Deed, ...]:
    """Put nulls around frames."""
    return tuple(Deed(bytes(nulls) + data + bytes(nulls)) for data in frames)


def burst(frames: Iterable[bytes], baud: int = 19_200) -> tuple[Deed, ...]:
    """Send many frames without waiting for any reply."""
    return (Deed(b"".join(frames), baud),)


def sweep(baud: int = 19_200) -> tuple[Deed, ...]:
    """Look for modules by No Operation at the addresses 0 to 32."""
    return tuple(Deed(frame(address, 0xE), baud) for address in range(33))


def probing() -> tuple[Deed, ...]:
    """Reset and sweep at every rate."""
    return tuple(
        deed
        for baud in BAUD_CODES
        for deed in (Deed(bytes(20), baud), *hard_reset(0.002, baud), *sweep(baud), *enumeration(2, baud))
    )


def individual_baud(address: int, baud: int) -> tuple[Deed, ...]:
    """Change the rate of a single module, and talk to it there."""
    return (Deed(frame(address, 0xA, BAUD_CODES[baud])), Deed(frame(address, 0xE), baud))


def individual_baud_and_back(address: int, baud: int) -> tuple[Deed, ...]:
    """Change the rate of a single module, and later change it back."""
    back = Deed(frame(address, 0xA, BAUD_CODES[19_200]), baud)
    return (*individual_baud(address, baud), back, Deed(frame(address, 0xE)))


def new_address(old: int, new: int) -> tuple[Deed, ...]:
    """Give a module that has an address another one."""
    return (Deed(frame(old, 0x1, new, 0xFF)), Deed(frame(new, 0xE)))


def powered(address: int) -> tuple[Deed, ...]:
    """Load gains of KP=350 KD=3000 KI=400 and close the loop."""
    gains = bytes.fromhex("5e01 b80b 9001 9001 fa 00 a00f 01 00")
    return (
        Deed(frame(address, 0x6, *gains)),
        Deed(frame(address, 0x7, 0x05)),
        Deed(frame(address, 0xB)),
    )


def jog(address: int, velocity: int = 5 << 16) -> tuple[Deed, ...]:
    """Run in velocity mode."""
    data = velocity.to_bytes(4, "little") + (2000).to_bytes(4, "little")
    return (Deed(frame(address, 0x4, 0xB6, *data), pause_s=0.1),)


class RoughHost(Receiver):
    """A host that does as it likes with the line, however the bytes are cut.

    Attributes:
        heard: everything that came back.
    """

    def __init__(self, line: SimulatedLine) -> None:
        self._line = line
        self.heard = bytearray()
        line.attach(self)

    @override
    def data_received(self, data: bytes) -> None:
        self.heard += data

    @override
    def transport_lost(self, reason: str) -> None:
        raise AssertionError(reason)

    async def do(self, deeds: Iterable[Deed], cuts: Iterator[tuple[int, float]]) -> None:
        """Do one after another.

        Args:
            deeds: what.
            cuts: how long each write is, in bytes, and how long the host then pauses, in seconds.
        """
        for deed in deeds:
            self._line.set_baud(deed.baud)
            rest = deed.data
            while rest:
                length, gap_s = next(cuts)
                self._line.write(rest[:length])
                rest = rest[length:]
                await asyncio.sleep(gap_s)
            await asyncio.sleep(deed.pause_s + len(deed.data) * 10 / deed.baud)

    async def leave(self) -> None:
        """Close the port; the next host finds the rate of a port that was just opened."""
        self._line.set_baud(19_200)
        await self._line.close()


async def rough_host(chain: Chain) -> RoughHost:
    """Open the line for a rough host."""
    return RoughHost(await open_simulated_line(chain))
