"""A serial server that takes the port's settings over the connection (`rfc2217://host:port`) as a byte pipe.

Sources: RFC 2217 for the settings, RFC 854 and 856 for Telnet and its binary transmission. What is set and what is sent
go in one stream, so that bytes behind a change of the rate leave at the new one. The server answers with what its port
really does: a rate that it does not make ends the pipe, as on a port of this machine.
"""

import asyncio
import contextlib
from collections.abc import Callable
from enum import IntEnum

from typing_extensions import override

from ldcnd.contract.errors import TransportLost
from ldcnd.line.rates import STANDARD_BAUDS, makes, nearest
from ldcnd.line.tcp_port import CONNECT_TIME_S, TcpPort, address, connected, unreachable
from ldcnd.line.transport import Framing, Incoming, Transport

IAC, DONT, DO, WONT, WILL, SB, SE = 255, 254, 253, 252, 251, 250, 240
BINARY, SUPPRESS_GO_AHEAD, COM_PORT = 0, 3, 44
WANTED = (BINARY, SUPPRESS_GO_AHEAD, COM_PORT)
ANSWERED = 100
"""A server's answer to a setting has this more than the setting."""
LONGEST_SETTING = 64
"""Bytes; a server that sends more without an end sends something else."""
NEGOTIATION_TIME_S = 5.0


class PortSetting(IntEnum):
    """What can be set (RFC 2217, section 2)."""

    RATE = 1
    DATA_BITS = 2
    PARITY = 3
    STOP_BITS = 4
    CONTROL = 5


# values of SET-CONTROL (RFC 2217, section 3); a port of this machine is opened with both outputs on, too
NO_FLOW_CONTROL, DTR_ON, RTS_ON = 1, 8, 11
FRAMINGS = {"8n1": (8, 1, 1), "7e1": (7, 3, 1)}
"""Data bits, parity and stop bits as RFC 2217 numbers them."""


class Telnet(Incoming):
    """Takes Telnet's commands out of what comes, and keeps what the server has answered.

    Attributes:
        refused: options that the server does not want.
        agreed: options that it has, or lets this end have.
        made: what its port does by setting, as it has answered.
        told: called after each command, and at the end.
    """

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.refused: set[int] = set()
        self.agreed: set[int] = set()
        self.made: dict[int, int] = {}
        self.told: Callable[[], None] = lambda: None
        self._begun = bytearray()  # a command whose end has not come yet

    @override
    def data_received(self, data: bytes) -> None:
        if plain := self._without_commands(data):
            super().data_received(plain)

    @override
    def drop(self, data: bytes) -> None:
        super().drop(self._without_commands(data))

    @override
    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self.told()

    def _without_commands(self, data: bytes) -> bytes:
        if not self._begun and IAC not in data:
            return data
        plain = bytearray()
        for byte in data:
            if not self._begun and byte != IAC:
                plain.append(byte)
                continue
            self._begun.append(byte)
            if self._begun == bytes((IAC, IAC)):
                plain.append(IAC)
                self._begun.clear()
            elif self._is_whole():
                self._heed(bytes(self._begun))
                self._begun.clear()
        return bytes(plain)

    def _is_whole(self) -> bool:
        begun = self._begun
        if len(begun) == 1:
            return False
        if begun[1] == SB:
            escapes = len(begun) - 1 - len(begun[:-1].rstrip(b"\xff"))  # two stand for the value 255
            return (begun[-1] == SE and escapes % 2 == 1) or len(begun) > LONGEST_SETTING
        return begun[1] not in {WILL, WONT, DO, DONT} or len(begun) == len((IAC, WILL, COM_PORT))

    def _heed(self, command: bytes) -> None:
        kind = command[1]
        if kind in (WILL, DO):
            self.agreed.add(command[2])
        elif kind in (WONT, DONT):
            self.refused.add(command[2])
        elif kind == SB and command[2] == COM_PORT and command[-1] == SE:
            value = command[4:-2].replace(b"\xff\xff", b"\xff")
            self.made[command[3] - ANSWERED] = int.from_bytes(value, "big")
        self.told()


class Rfc2217Port(TcpPort):
    """An open connection to a serial server whose port is set from here."""

    fixed_baud = False

    def __init__(self, stream: asyncio.Transport, incoming: Telnet) -> None:
        super().__init__(stream, incoming)
        self._telnet = incoming
        self._told = asyncio.Event()
        self._bauds: tuple[int, ...] = ()
        incoming.told = self._told.set

    async def negotiate(self, framing: Framing, bauds: tuple[int, ...]) -> None:
        """Agree on the options, set the framing, find out which rates the server makes, and leave it at the last one.

        Raises:
            TransportLost: the server does not do that.
        """
        for option in WANTED:
            self._stream.write(bytes((IAC, WILL, option, IAC, DO, option)))
        # the one without which nothing can be set; where binary transmission is refused, `_next` ends it
        while COM_PORT not in self._telnet.agreed:
            await self._next()
        values = dict(
            zip((PortSetting.DATA_BITS, PortSetting.PARITY, PortSetting.STOP_BITS), FRAMINGS[framing], strict=True)
        )
        for setting, value in values.items():
            if (made := await self._settled(setting, value)) != value:
                raise self._refused(f"it has {made} instead of {value} for {setting.name.lower().replace('_', ' ')}")
        for value in (NO_FLOW_CONTROL, DTR_ON, RTS_ON):
            self._set(PortSetting.CONTROL, value)
        # tried before a drive is set to one, as on a port of this machine
        rates = {baud: await self._settled(PortSetting.RATE, baud) for baud in (*STANDARD_BAUDS, *bauds)}
        self._bauds = tuple(baud for baud, made in rates.items() if makes(baud, made))
        for baud in bauds:
            if baud not in self._bauds:
                near = nearest(baud, sorted(self._bauds))
                raise self._refused(
                    f"it sends at {rates[baud]} instead of {baud} baud, the nearest that it makes: {near}"
                )
        await self._settled(PortSetting.RATE, bauds[-1])

    @override
    def offers(self, baud: int) -> bool:
        return baud not in STANDARD_BAUDS or baud in self._bauds

    @override
    def write(self, data: bytes) -> None:
        # a data byte of 255 is sent twice (RFC 854), as in a setting
        super().write(data.replace(b"\xff", b"\xff\xff"))

    @override
    def set_baud(self, baud: int) -> None:
        """See `Transport`; a server that makes another rate of it says so later, which ends the pipe."""
        if self._incoming.reason:
            raise TransportLost(self._incoming.reason)
        self._telnet.told = lambda: self._check(baud)
        self._telnet.made.pop(PortSetting.RATE, None)
        self._set(PortSetting.RATE, baud)

    def _check(self, baud: int) -> None:
        made = self._telnet.made.get(PortSetting.RATE)
        if not makes(baud, made):
            self._incoming.lost(f"it sends at {made} instead of {baud} baud")
            self._stream.abort()

    def _set(self, setting: PortSetting, value: int) -> None:
        # SET-BAUDRATE has four octets, the others one (RFC 2217, section 3)
        width = 4 if setting is PortSetting.RATE else 1
        said = value.to_bytes(width, "big").replace(b"\xff", b"\xff\xff")
        self._stream.write(bytes((IAC, SB, COM_PORT, setting)) + said + bytes((IAC, SE)))

    async def _settled(self, setting: PortSetting, value: int) -> int:
        """Set something, and return what the server's port makes of it."""
        self._telnet.made.pop(setting, None)
        self._set(setting, value)
        while setting not in self._telnet.made:
            await self._next()
        return self._telnet.made[setting]

    async def _next(self) -> None:
        """Wait for the server's next answer."""
        if self._incoming.reason:
            raise self._refused(self._incoming.reason.removeprefix(f"{self._incoming.name} was lost: "))
        if refused := self._telnet.refused & {BINARY, COM_PORT}:
            raise self._refused(f"it refuses {'binary transmission' if BINARY in refused else 'RFC 2217'}")
        self._told.clear()
        await self._told.wait()

    def _refused(self, why: str) -> TransportLost:
        remedy = "set the serial server to RFC 2217, or use socket:// and set its port there"
        return unreachable(self._incoming.name, why, remedy)


async def open_rfc2217_port(host: str, port: int, framing: Framing, bauds: tuple[int, ...]) -> Transport:
    """Connect to a serial server and set its port.

    Args:
        host: name or address of the server.
        port: its TCP port.
        framing: data bits, parity, stop bits.
        bauds: rates that it has to make; the last one is left set.

    Raises:
        TransportLost: it cannot be reached, speaks no RFC 2217, or its port does not have that framing or these rates.
    """
    name = address("rfc2217", host, port)
    opened = Rfc2217Port(*await connected(Telnet(name), host, port, CONNECT_TIME_S))
    try:
        async with asyncio.timeout(NEGOTIATION_TIME_S):
            await opened.negotiate(framing, bauds)
    except BaseException as error:
        with contextlib.suppress(TransportLost):
            await opened.close()
        if isinstance(error, TimeoutError):
            why = f"it answers no setting within {NEGOTIATION_TIME_S:g} s"
            raise opened._refused(why) from None  # noqa: SLF001 - of this module
        raise
    return opened
