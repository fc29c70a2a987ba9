"""Exchanges with one drive, and its error replies as errors of ldcnd.

Source: manual 2.2 (5) "Status"; 4 "Data setting limit".
"""

import asyncio
import math
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TypeVar

from ldcnd.contract.errors import (
    AddressRefused,
    BusDown,
    BusError,
    BusyTracing,
    ByteCountRefused,
    DataRefused,
    DriveFault,
    OutcomeUnknown,
    ReplyTimeout,
    WrongState,
)
from ldcnd.drives.smartstep import commands
from ldcnd.drives.smartstep.addresses import OperatingMode, Register
from ldcnd.drives.smartstep.commands import Refusal, RefusalReason
from ldcnd.drives.smartstep.packet import PACKET_CHARACTERS, ReplyReader
from ldcnd.drives.smartstep.profiles import SmartStepProfile
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Exchange, Lane, PacketEffect
from ldcnd.line.flight_recorder import WireEvent


def drive_error(axis: str, refusal: Refusal, mode: OperatingMode | int = OperatingMode.NORMAL) -> DriveFault:
    """Return the error that an error reply stands for.

    Args:
        axis: who declined.
        refusal: how.
        mode: what 2000H says; in Data Trace Mode a setting's address error means that the drive is busy.
    """
    message = f"axis {axis}: {refusal}"
    match refusal.reason_in(mode):
        case RefusalReason.TRACING:
            return BusyTracing(
                f"axis {axis}: busy tracing: the drive takes no setting in Data Trace Mode (e={refusal.status:X})",
                axis=axis,
                remedy="wait for the end of the trace, or end it",
            )
        case RefusalReason.ADDRESS:
            return AddressRefused(message, axis=axis, value=f"{refusal.address:04X}H")
        case RefusalReason.BYTE_COUNT:
            return ByteCountRefused(message, axis=axis, value=refusal.data)
        case RefusalReason.DATA:
            return DataRefused(message, axis=axis, value=refusal.data)


ValueT = TypeVar("ValueT")

READ_BACK_ROUNDS = 4
"""Rounds of the bus's own attempts before a write whose reply was lost stays unknown."""


def stray_packets(bus: Bus, since_s: float) -> list[bytes]:
    """Return the packets that came unasked since an instant of the loop's clock."""
    stray = b"".join(
        record.data for record in bus.wire_log.records() if record.event is WireEvent.STRAY and record.at_s >= since_s
    )
    return ReplyReader(PACKET_CHARACTERS).feed(stray)  # a port may deliver them in pieces


class CounterClears:
    """How often the counters of a drive were cleared, or may have been, by this host or a guest of it.

    The halves of a counter are of one count only if as many clears were over when the first was requested as when the
    last came.
    """

    def __init__(self) -> None:
        self._under_way = self._over = 0
        self._lasts_until_s = -math.inf

    @property
    def over(self) -> int | None:
        """How many are over; None while one may be under way."""
        if self._under_way or asyncio.get_running_loop().time() < self._lasts_until_s:
            return None
        return self._over

    @contextmanager
    def clearing(self, lasts_s: float = 0.0) -> Iterator[None]:
        """Take note that a counter may be cleared within this context, and for so long behind it."""
        self._under_way += 1
        try:
            yield
        finally:
            self._under_way -= 1
            self._over += 1
            self._lasts_until_s = asyncio.get_running_loop().time() + lasts_s  # the drive clears one at a time


class Words:
    """One drive as the words at its addresses.

    Attributes:
        clears: of its counters.
        self_hearing: the drive takes its own replies for commands. A zero word, or the reply to a setting, makes it
            answer itself without end, so nothing more is sent.
        nonsense: how something has answered at its number that is no drive of this family; empty otherwise.
    """

    def __init__(self, bus: Bus, axis: str, unit: int, profile: SmartStepProfile) -> None:
        self.axis = axis
        self.unit = unit
        self.clears = CounterClears()
        self.self_hearing = False
        self.nonsense = ""
        self._bus = bus
        self._profile = profile
        self._proof = bus.proofs.expect(unit, f"axis {axis}", axis)
        self._type: int | None = None

    async def ask(
        self, exchange: Exchange[ValueT | Refusal], lane: Lane = Lane.COMMAND, *, once: bool = False
    ) -> ValueT:
        """Run one exchange, in the response time of the profile; with `once` it is never sent again.

        Raises:
            WrongState: the drive receives its own replies.
            DriveFault: the drive declined; a setting's address error is distinguished from "busy tracing" by the mode.
            BusError: the line failed.
        """
        if self.self_hearing:
            raise WrongState(
                f"axis {self.axis}: the drive takes its own replies for commands; nothing is sent on these wires",
                axis=self.axis,
                value="self_hearing",
                remedy="use four wires",
            )
        if exchange.effect is PacketEffect.CHANGES:
            await self.identify()
        answer = await self._bus.execute(commands.with_response_time(exchange, self._profile), lane, once=once)
        if isinstance(answer, Refusal):
            mode = await self._mode_of(answer)
            raise drive_error(self.axis, answer, mode)
        return answer

    @property
    def is_identified(self) -> bool:
        """Whether what answers is known to be the drive; otherwise its words say nothing about it."""
        return self._proof.holds

    @property
    def is_lost(self) -> bool:
        """Whether the line has given the drive up because it was silent; it counts again once it was identified."""
        return not (self._proof.holds or self._proof.is_another)

    def forget(self) -> None:
        """The line comes up: any drive may be there."""
        self._type = None
        self.nonsense = ""

    def refuse(self, problem: str) -> None:
        """What answers at this number is no drive of this family: nothing that it says identifies it."""
        self.nonsense = problem
        self._proof.lose(problem, silent=False)

    async def identify(self) -> None:
        """Read which drive answers, unless that is known.

        Raises:
            As `ask`.
        """
        if not self._proof.holds:
            self.identified(await self.read(Register.DRIVER_TYPE))

    def identified(self, type_word: int) -> None:
        """Take the driver type that was read: another one than before is another drive."""
        if self.nonsense:
            return
        # the first one after the line came up is believed: nothing tells drives of one type apart
        if self._type in (None, type_word):
            self._type = type_word
            self._proof.prove()
        else:
            self._proof.lose(
                f"unit {self.unit} is a driver of type {type_word:04X}H, and was one of {self._type:04X}H", silent=False
            )

    async def answers(self, unit: int) -> bool:
        """Return whether any drive of the line has this unit number; the exchange changes nothing."""
        try:
            await self._bus.execute(commands.with_response_time(commands.probe(unit), self._profile), Lane.COMMAND)
        except ReplyTimeout:
            return False
        return True

    async def read(self, address: int) -> int:
        """Read one word.

        Raises:
            As `ask`.
        """
        return await self.ask(commands.reference(self.unit, address))

    async def read_back(self, address: int) -> int:
        """Read a word that decides what became of a write; tries longer than others.

        Raises:
            OutcomeUnknown: the line does not let it through.
        """
        for _ in range(READ_BACK_ROUNDS):
            try:
                return await self.read(address)
            except ReplyTimeout:
                continue
            # there is nobody to ask until it is open again, and the caller waits
            except BusDown:
                break
        raise OutcomeUnknown(
            f"axis {self.axis}: a write could not be read back from {address:04X}H; it may or may not have been done",
            axis=self.axis,
            remedy="read the parameter before anything else",
        )

    async def mode(self) -> OperatingMode | int:
        """Read the operating mode."""
        return await self.ask(commands.read_operating_mode(self.unit))

    async def _mode_of(self, refusal: Refusal) -> OperatingMode | int:
        """Return the mode in which a drive declined, as far as it matters for the reason."""
        # a trace would make no difference: the mode need not be read
        if refusal.reason_in(OperatingMode.DATA_TRACE) is refusal.reason:
            return OperatingMode.NORMAL
        try:
            answer = await self._bus.execute(commands.read_operating_mode(self.unit))
        except BusError:
            return OperatingMode.NORMAL  # that the drive declined is certain, only the reason is not
        return OperatingMode.NORMAL if isinstance(answer, Refusal) else answer
