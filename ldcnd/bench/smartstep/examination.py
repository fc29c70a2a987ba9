"""Examining one drive before it is used: is it alive, what is it, how are its wires, which assumptions can be verified.

Reads at even addresses and even counts only: what a drive does with odd ones is not known. Run it with RUN off.
Source: manual 2 to 6; the order goes from what is safe with any drive to what requires most of it.
"""

import asyncio
from collections.abc import AsyncGenerator, Callable, Sequence

from ldcnd.contract.errors import BadReply, BusError, DriveFault
from ldcnd.contract.health import Finding, Verdict
from ldcnd.drives.smartstep import commands
from ldcnd.drives.smartstep.addresses import TRACE_1_AREA, OperatingMode, Register
from ldcnd.drives.smartstep.commands import LONGEST_STRING_BYTES, Refusal, StringReply, string_reference
from ldcnd.drives.smartstep.drive import SmartStepAxis
from ldcnd.drives.smartstep.monitors import (
    INPUT_COUNTER_LOW,
    AlarmKind,
    FunctionSwitch,
    alarm,
    function_switches,
    gain_switch,
)
from ldcnd.drives.smartstep.network import hears_itself
from ldcnd.drives.smartstep.packet import DAMAGED, HIGHEST_UNIT
from ldcnd.drives.smartstep.parameters import PN000, unit_number
from ldcnd.drives.smartstep.profiles import SmartStepProfile
from ldcnd.drives.smartstep.words import Words
from ldcnd.line.bus import Bus
from ldcnd.line.flight_recorder import WireEvent, WireRecord


async def examine(bus: Bus, unit: SmartStepAxis) -> AsyncGenerator[Finding]:
    """Examine one drive on an open line that no other program uses; yields each finding as it comes.

    It reads only. Ends early when the drive does not answer or receives its own replies.
    """
    examination = Examination(bus, unit)
    alive = await examination.alive()
    yield alive
    if alive.verdict is Verdict.WRONG:
        return
    for part in (
        examination.wires,
        examination.identity,
        examination.state,
        examination.trace_constants,
        examination.memories,
        examination.strings,
        examination.string_range,
        examination.longest_string,
        examination.atomic_counter,
    ):
        try:
            finding = await part()
        except (BusError, DriveFault) as error:
            finding = examination.finding(part.__name__.replace("_", " "), Verdict.LOOK, error.message)
        yield finding
        if finding.verdict is Verdict.WRONG:
            return


class Examination:
    """The parts of the examination of one drive; each raises the `BusError` or `DriveFault` that befell it."""

    def __init__(self, bus: Bus, unit: SmartStepAxis) -> None:
        self._bus = bus
        self._unit = unit
        self._words = unit.words

    def finding(self, what: str, verdict: Verdict, text: str, verifies: str | None = None) -> Finding:
        """Return a finding about this drive."""
        return Finding(axis=self._unit.spec.name, what=what, verdict=verdict, text=text, verifies=verifies)

    async def alive(self) -> Finding:
        """Read an address that never exists: the known error reply proves drive, line and unit number."""
        number = self._unit.spec.address
        try:
            await self._bus.execute(commands.with_response_time(commands.probe(number), self._unit.profile))
        except BadReply:
            text = 'the host hears itself: set echo = "expect"'
            return self.finding("alive", Verdict.WRONG, text, "echo")
        except BusError as error:
            return self.finding("alive", Verdict.WRONG, f"unit {number} does not answer: {error.message}")
        return self.finding("alive", Verdict.FINE, f"unit {number} answers", "echo")

    async def identity(self) -> Finding:
        """Read driver type and software version."""
        type_word = await self._words.read(Register.DRIVER_TYPE)
        self._unit.identified(type_word, await self._words.read(Register.SOFTWARE_VERSION))
        return self.finding("identity", Verdict.FINE, self._unit.identity or "")

    async def state(self) -> Finding:
        """Read alarm, operating mode, switches and the unit number that is stored."""
        present = alarm(await self._words.read(Register.PRESENT_ALARM))
        mode = await self._words.mode()
        switches = function_switches(await self._words.read(Register.FUNCTION_SWITCHES))
        gain = gain_switch(await self._words.read(Register.GAIN_SWITCH))
        stored = unit_number(await self._words.read(PN000.eeprom_address))
        rule = "parameters rule" if FunctionSwitch.PARAMETERS_RULE in switches else "switches rule"
        fine = present.kind is AlarmKind.NONE and mode == OperatingMode.NORMAL and stored == self._unit.spec.address
        text = (
            f"alarm {present.code:02X} ({present.text}); mode {mode:04X}H; gain switch {gain:X}; switch 6: {rule};"
            f" unit {stored} in Pn000.2"
        )
        return self.finding("state", Verdict.FINE if fine else Verdict.LOOK, text, "unit_digit")

    async def wires(self) -> Finding:
        """Read a word that is not zero and listen whether the drive answers itself."""
        if await hears_itself(self._bus, self._unit):
            self._words.self_hearing = True
            text = "the drive takes its own replies for commands: use four wires"
            return self.finding("wires", Verdict.WRONG, text, "wiring")
        return self.finding("wires", Verdict.FINE, "the drive does not hear itself", "wiring")

    async def trace_constants(self) -> Finding:
        """Read what scales a data trace."""
        cyclec = await self._words.read(Register.CYCLEC)
        maxtrqc = await self._words.read(Register.MAXTRQC)
        osvelcc = await self._words.read(Register.OSVELCC)
        verdict = Verdict.FINE if cyclec and maxtrqc and osvelcc else Verdict.LOOK
        text = f"CYCLEC {cyclec} us, MAXTRQC {maxtrqc} %, OSVELCC {osvelcc} r/min"
        return self.finding("trace constants", verdict, text)

    async def memories(self) -> Finding:
        """Compare RAM with EEPROM for every listed parameter."""
        values = await self._unit.parameters.read_all()
        differing = [f"{value.parameter} {value.active}/{value.stored}" for value in values if value.differs]
        if not differing:
            return self.finding("memories", Verdict.FINE, f"{len(values)} parameters, in use as stored")
        return self.finding("memories", Verdict.LOOK, f"in use/stored differ: {', '.join(differing)}")

    async def strings(self) -> Finding:
        """Read short strings: the checksum variant, and whether an address holds a byte."""
        start = TRACE_1_AREA.start
        one = await self._string(start, 2)
        both = await self._string(start, 4)
        second = await self._string(start + 2, 2)
        if isinstance(one, Refusal) or isinstance(both, Refusal) or isinstance(second, Refusal):
            return self.finding("strings", Verdict.LOOK, "string references are refused", "string_checksum")
        if not any(both.data):
            text = "the trace memory is empty, so a byte in the wrong place would not show: record a trace first"
            return self.finding("strings", Verdict.LOOK, text)
        by_bytes = both.data == one.data + second.data
        fits = one.fits & both.fits & second.fits
        names = ", ".join(sorted(fit.value for fit in fits)) or "none in common"
        text = f"an address holds {'a byte' if by_bytes else 'something else'}; checksum covers: {names}"
        return self.finding("strings", Verdict.FINE if by_bytes and fits else Verdict.LOOK, text, "string_checksum")

    async def string_range(self) -> Finding:
        """Read the last word of a trace memory, and one beyond: the second must be refused."""
        last = await self._string(TRACE_1_AREA.stop - 2, 2)
        beyond = await self._string(TRACE_1_AREA.stop, 2)
        fine = not isinstance(last, Refusal) and isinstance(beyond, Refusal)
        text = f"last word: {last if isinstance(last, Refusal) else 'read'}; beyond: {beyond}"
        return self.finding("string range", Verdict.FINE if fine else Verdict.LOOK, text, "string_count_unit")

    async def longest_string(self) -> Finding:
        """Read a whole trace memory at once; this holds the line for two seconds."""
        whole = await self._string(TRACE_1_AREA.start, LONGEST_STRING_BYTES)
        if isinstance(whole, Refusal):
            return self.finding("longest string", Verdict.FINE, f"{whole}: use chunks", "trace_chunk_bytes")
        return self.finding("longest string", Verdict.FINE, "1000 bytes in one reply", "trace_chunk_bytes")

    async def atomic_counter(self) -> Finding:
        """Try whether one string reference returns both halves of a counter."""
        halves = await self._string(INPUT_COUNTER_LOW.address, 4)
        can = "can" if isinstance(halves, StringReply) else "cannot"
        return self.finding("atomic counter", Verdict.FINE, f"a counter {can} be read at once", "atomic_counter")

    async def _string(self, address: int, byte_count: int) -> StringReply | Refusal:
        return await self._bus.execute(
            string_reference(self._unit.spec.address, address, byte_count, self._unit.profile)
        )


# -- the line as a whole ---------------------------------------------------------------------------------------------


async def scan(
    bus: Bus, profile: SmartStepProfile, found: Callable[[int, str], None] = lambda *_: None
) -> AsyncGenerator[Finding]:
    """Probe every unit number from 0 to F for a drive; yields each drive, or why there is none.

    Works best on a line that makes parity in software: then characters with wrong parity are seen as such.

    Args:
        bus: open.
        profile: how words are sent.
        found: takes the number of each unit, and what it says of itself.
    """
    answered = 0
    began_s = asyncio.get_running_loop().time()
    for unit in range(HIGHEST_UNIT + 1):
        words = Words(bus, f"unit {unit:X}", unit, profile)
        if not await words.answers(unit):
            continue
        answered += 1
        try:
            type_word, version = await words.read(Register.DRIVER_TYPE), await words.read(Register.SOFTWARE_VERSION)
            present = alarm(await words.read(Register.PRESENT_ALARM))
        except (BusError, DriveFault) as error:
            found(unit, error.message)
            yield Finding(axis=words.axis, what="scan", verdict=Verdict.LOOK, text=error.message)
            continue
        text = f"driver type {type_word:04X}H, version {version:04X}H, alarm {present.code:02X} ({present.text})"
        found(unit, text)
        yield Finding(axis=words.axis, what="scan", verdict=Verdict.FINE, text=text)
    if not answered:
        text = diagnosis([record for record in bus.wire_log.records() if record.at_s >= began_s])
        yield Finding(axis="-", what="scan", verdict=Verdict.WRONG, text=text, verifies="wiring")


def diagnosis(records: Sequence[WireRecord]) -> str:
    """Return why no drive answers, by what came back on the line."""
    sent = b"".join(record.data for record in records if record.event is WireEvent.SENT)
    heard = b"".join(record.data for record in records if record.event in _HEARD)
    if not heard:
        return (
            "nothing comes back: check the power of the drives, that the host's pair for sending goes to RXD (20, 21)"
            " and the other to TXD (22, 23), plus to plus, the common ground, and the unit numbers in Pn000.2"
        )
    if sent.startswith(heard) or heard in sent:
        return (
            'the host hears itself and no drive answers: set wiring = "2-wire" and echo = "expect", or use four wires'
        )
    wrong = heard.count(DAMAGED)
    if wrong * 2 >= len(heard):
        return (
            f"{wrong} of {len(heard)} characters that came back have wrong parity: plus and minus of a pair may be"
            " exchanged, a drive with unit number 0 may jam the line, or something sends at another rate than 9600 baud"
        )
    return (
        f"{len(heard)} characters came back that no SmartStep sends, such as {heard[:14]!r}: other devices on the line"
    )


_HEARD = (WireEvent.RECEIVED, WireEvent.PART, WireEvent.STRAY, WireEvent.ECHO)
