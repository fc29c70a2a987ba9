"""One SmartStep line: its port, which units answer on it, their models, whether one receives its own replies.

The port pauses before each packet, so that a drive has time to release its transmitter (the manual gives no time, the
profile does), and makes parity in software where the adapter cannot. Units have no addressing procedure: their numbers
are set in Pn000.2. A silent unit does not keep the others from being served; it is probed at increasing intervals.
Source: manual 2.1, 2.2.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from typing import Any

from typing_extensions import override

from ldcnd.contract.errors import (
    BadReply,
    BusBusy,
    BusDown,
    DriveFault,
    LdcndError,
    NetworkMismatch,
    ReplyTimeout,
    TransportLost,
    WrongState,
)
from ldcnd.drives.driver import Drive
from ldcnd.drives.network import BringUpReport, Network
from ldcnd.drives.smartstep import commands
from ldcnd.drives.smartstep.addresses import Register
from ldcnd.drives.smartstep.drive import SmartStepAxis, UnitSpec
from ldcnd.drives.smartstep.modes import end_mode
from ldcnd.drives.smartstep.monitors import R7D_AP, FunctionSwitch, function_switches
from ldcnd.drives.smartstep.packet import add_parity, strip_parity
from ldcnd.drives.smartstep.parameters import PN000, PN100, unit_number
from ldcnd.drives.smartstep.poller import STRAY_WAIT_S
from ldcnd.drives.smartstep.profiles import SMARTSTEP, Framing, SmartStepProfile
from ldcnd.drives.smartstep.unit_numbers import UnitNumbers
from ldcnd.drives.smartstep.words import stray_packets
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Exchange, Resync
from ldcnd.line.settings import BusSettings
from ldcnd.line.transport import Opener, Receiver, Transport
from ldcnd.log import get_logger

BAUD = 9600
"""The only rate (manual 2.1)."""
OF_THE_LINE = (BusDown, BusBusy, TransportLost, NetworkMismatch)
"""Errors that are not of one unit: the line was lost, or its wiring is wrong."""


class SmartStepPort(Transport):
    """An open port with the SmartStep's framing and pauses; also the receiver of the port that it wraps."""

    def __init__(self, port: Transport, framing: Framing, quiet_s: float) -> None:
        self._port = port
        self._soft_parity = framing is Framing.SOFT_PARITY
        self._quiet_s = quiet_s
        self._loop = asyncio.get_running_loop()
        self._receiver: Receiver | None = None
        self._quiet_from_s = 0.0
        self._held_back: deque[bytes] = deque()
        self._timer: asyncio.TimerHandle | None = None

    # -- transport ---------------------------------------------------------------------------------------------------

    @override
    def attach(self, receiver: Receiver) -> None:
        self._receiver = receiver
        self._port.attach(self)

    def write(self, data: bytes) -> None:
        """See `Transport`; what has to wait for silence leaves a few milliseconds later."""
        self._held_back.append(add_parity(data) if self._soft_parity else data)
        if self._timer is None:
            wait_s = self._quiet_from_s + self._quiet_s - self._loop.time()
            if wait_s > 0:
                self._timer = self._loop.call_later(wait_s, self._release)
            else:
                self._send()

    @override
    def expect(self, reply_bytes: int) -> None:
        self._port.expect(reply_bytes)

    @override
    def collect(self) -> None:
        self._port.collect()

    @override
    def discard_input(self) -> None:
        self._port.discard_input()

    @override
    def set_baud(self, baud: int) -> None:
        self._port.set_baud(baud)

    async def close(self) -> None:
        """See `Transport`; what is held back is dropped."""
        self._forget()
        self._receiver = None
        await self._port.close()

    # -- receiver ----------------------------------------------------------------------------------------------------

    def data_received(self, data: bytes) -> None:
        """Pass bytes of the line on, without their parity where that is kept in software."""
        self._quiet_from_s = self._loop.time()
        if self._receiver:
            self._receiver.data_received(strip_parity(data) if self._soft_parity else data)

    def transport_lost(self, reason: str) -> None:
        """Tell the receiver that the line is gone."""
        self._forget()
        if self._receiver:
            self._receiver.transport_lost(reason)

    # -- silence -----------------------------------------------------------------------------------------------------

    def _release(self) -> None:
        self._timer = None
        try:
            self._send()
        except TransportLost as error:
            self.transport_lost(error.message)

    def _send(self) -> None:
        while self._held_back:
            self._port.write(self._held_back.popleft())

    def _forget(self) -> None:
        self._held_back.clear()
        if self._timer:
            self._timer.cancel()
            self._timer = None


def smartstep_opener(opener: Opener, profile: SmartStepProfile) -> Opener:
    """Return an opener of the same port for a line of these drives."""

    async def open_port() -> Transport:
        return SmartStepPort(await opener(), profile.framing, profile.quiet_s)

    return open_port


log = get_logger("smartstep")


def smartstep_line(
    settings: BusSettings, opener: Opener, specs: tuple[UnitSpec, ...]
) -> tuple[Bus, "SmartStepNetwork"]:
    """Return a bus that is not open yet, and its network."""
    answering: list[int] = []

    def probe(avoid: AbstractSet[int]) -> Exchange[Any] | None:
        # no other command's reply carries the address of the probe
        candidates = [number for number in answering if number not in avoid] or answering
        return commands.probe(candidates[0]) if candidates else None

    # its time-out has waited for a reply to begin; one that has begun goes on within the gap between characters
    bus = Bus(settings, opener, Resync(flush=commands.FLUSH, quiet_s=SMARTSTEP.gap_s, settle_s=0.005, probe=probe))
    return bus, SmartStepNetwork(bus, specs, answering)


class SmartStepNetwork(Network):
    """The units of one line.

    Args:
        bus: the line.
        specs: the units.
        answering: gets the units that answer; a resynchronisation asks one of them.
    """

    def __init__(self, bus: Bus, specs: tuple[UnitSpec, ...], answering: list[int]) -> None:
        self._bus = bus
        self._numbers = UnitNumbers({spec.axis.address: spec.axis.name for spec in specs})
        self._stored: dict[str, int] = {}  # unit numbers in EEPROM, as the bring-up has found them
        self._units = {spec.axis.address: SmartStepAxis(spec, bus, self._numbers) for spec in specs}
        self._answering = answering
        self.axes: Mapping[str, Drive] = {unit.spec.name: unit for unit in self._units.values()}

    async def bring_up(self) -> BringUpReport:
        """See `Network`: read the identity of every unit; only reads.

        Raises:
            NetworkMismatch: no unit answers at all, or one takes its own replies for commands.
            BusError: the line failed meanwhile.
        """
        self._answering.clear()
        self._stored.clear()
        remarks: list[str] = []
        for unit in self._units.values():
            unit.wires_checked = False
            unit.words.forget()
        for unit in self._units.values():
            remarks += await self._greet(unit)
        name = self._bus.settings.name
        if not self._answering:
            raise NetworkMismatch(
                f"bus {name}: none of the {len(self._units)} configured SmartStep units answers",
                remedy="check wiring, 9600 baud 7E1, and the unit numbers in Pn000.2",
            )
        log.info("network up", bus=name, units=list(self._answering))
        return BringUpReport(
            baud=self._bus.baud,
            identities={unit.spec.name: unit.identity for unit in self._units.values() if unit.identity},
            reset=False,
            remarks=tuple(remarks),
        )

    @override
    def incomplete(self) -> bool:
        return any(unit.words.nonsense for unit in self._units.values())

    @override
    async def rejoin(
        self, restarted: Callable[[str], None], heard: Callable[[str], None] = lambda _: None
    ) -> frozenset[str]:
        """See `Network`: ask again who has answered nonsense; a silent one is found by its polls."""
        found = set()
        for unit in self._units.values():
            if not unit.words.nonsense:
                continue
            for remark in await self._greet(unit):
                log.debug("unit asked again", unit=unit.spec.address, remark=remark)
            if unit.wires_checked and not unit.words.nonsense:
                found.add(unit.spec.name)
                heard(unit.spec.name)
        return frozenset(found)

    @property
    @override
    def problem(self) -> str:
        return "; ".join(_answers_nonsense(unit) for unit in self._units.values() if unit.words.nonsense)

    async def _greet(self, unit: SmartStepAxis) -> list[str]:
        """Find out what answers at the number of a unit, and whether it may be asked; return what deserves attention.

        Raises:
            NetworkMismatch: it takes its own replies for commands.
            BusError: the line failed.
        """
        who, number = f"unit {unit.spec.address} (axis {unit.spec.name})", unit.spec.address
        heard = False
        try:
            await self._bus.execute(commands.with_response_time(commands.probe(number), unit.profile))
            heard = True
            if number not in self._answering:
                self._answering.append(number)
            # first: what follows reads words that may be zero
            await self._check_wires(unit)
            unit.wires_checked, unit.words.nonsense = True, ""
            return await self._meet(unit)
        except OF_THE_LINE:
            raise
        except (BadReply, DriveFault) as error:  # no drive of this family answers so, or lacks these words
            unit.words.refuse(error.message)
            return [_answers_nonsense(unit)]
        # one unit must not keep the others of its line from being served
        except LdcndError as error:
            silent = not heard and isinstance(error, ReplyTimeout)
            return [f"{who} does not answer" if silent else f"{who}: {error.message}"]

    async def _check_wires(self, unit: SmartStepAxis) -> None:
        """Refuse a line on which a drive receives its own replies, before a word is read that may be zero.

        Raises:
            NetworkMismatch: it does.
        """
        if await hears_itself(self._bus, unit):
            unit.words.self_hearing = True
            raise NetworkMismatch(
                f"bus {self._bus.settings.name}: unit {unit.spec.address} (axis {unit.spec.name}) takes its own replies"
                " for commands; reading a zero or writing would make it answer itself without end",
                remedy="use four wires",
            )

    async def _meet(self, unit: SmartStepAxis) -> list[str]:
        """Learn what a unit is; return what deserves attention."""
        words, who = unit.words, f"unit {unit.spec.address} (axis {unit.spec.name})"
        remarks = []
        type_word = await words.read(Register.DRIVER_TYPE)
        unit.identified(type_word, await words.read(Register.SOFTWARE_VERSION))
        if type_word != R7D_AP:
            remarks.append(f"{who}: driver type {type_word:04X}H is not one that the manual lists")
        try:
            ended = await end_mode(words)
        except WrongState as error:
            remarks.append(f"{who}: {error.message}")
        else:
            if ended:
                remarks.append(
                    f"{who}: was left in operating mode {ended:04X}H by another host; it is in its normal mode now"
                )
        stored = self._stored[unit.spec.name] = unit_number(await words.read(PN000.eeprom_address))
        if stored != unit.spec.address:
            objection = self._numbers.objection(unit.spec.name, stored, self._stored)
            because = f", but {objection}" if objection else ""
            remarks.append(f"{who}: Pn000.2 makes it unit {stored} at its next power-on{because}")
        # which level means so is not in the manual (3, 8106H), so it is a remark and forbids nothing
        if FunctionSwitch.PARAMETERS_RULE not in function_switches(await words.read(Register.FUNCTION_SWITCHES)):
            remarks.append(f"{who}: its switches seem to overrule parameters (switch 6 is off)")
        return remarks


def _answers_nonsense(unit: SmartStepAxis) -> str:
    number, axis = unit.spec.address, unit.spec.name
    return f"unit {number} (axis {axis}) does not answer as a SmartStep does: {unit.words.nonsense}"


async def hears_itself(bus: Bus, unit: SmartStepAxis) -> bool:
    """Tell whether a drive takes its own replies for commands.

    A non-zero word makes it answer itself with a data error, which stops by itself: Pn100 is never zero.
    """
    # or the question that finds out would be refused
    unit.words.self_hearing = False
    await unit.words.read(PN100.ram_address)
    loop = asyncio.get_running_loop()
    heard_at_s = loop.time()
    await asyncio.sleep(STRAY_WAIT_S)
    return any(commands.is_self_hearing(unit.spec.address, packet) for packet in stray_packets(bus, heard_at_s))
