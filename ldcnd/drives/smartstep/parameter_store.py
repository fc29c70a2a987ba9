"""Parameters, counters and alarms of one drive on request of the daemon; RAM by default, EEPROM rarely.

EEPROM: the value is read first and nothing is sent if it is there already; each write is entered in the ledger before
it is sent; when its reply is lost, the memory is read back, and only a value that is still the old one lets the write
be sent again.
Source: manual 2.2, note on EEPROM; 3.
"""

from collections.abc import Callable
from contextlib import AbstractAsyncContextManager, nullcontext

from typing_extensions import override

from ldcnd.contract.errors import (
    AddressRefused,
    BadReply,
    BusBusy,
    BusDown,
    BusError,
    DataRefused,
    DriveFault,
    NotSupported,
    OutcomeUnknown,
    Remedy,
    RequestRefused,
    ValueOutOfRange,
    WrongState,
    step,
)
from ldcnd.contract.parameters import (
    AlarmEntry,
    CounterName,
    DigitInfo,
    DriveFacts,
    Memory,
    ParameterInfo,
    ParameterValue,
    PlannedParameters,
    PlanParameters,
    WriteParameter,
)
from ldcnd.contract.samples import MonitorName
from ldcnd.drives.parameter_access import ClearedCounter, MonitorValue, ParameterAccess, Written
from ldcnd.drives.smartstep.addresses import Register
from ldcnd.drives.smartstep.commands import write_eeprom, write_ram
from ldcnd.drives.smartstep.ledger import EEPROM_LIFE, WARNING_WRITES, EepromLedger
from ldcnd.drives.smartstep.modes import clear_counter, read_counter
from ldcnd.drives.smartstep.monitors import COUNTERS as MONITOR_COUNTERS
from ldcnd.drives.smartstep.monitors import (
    HISTORY_LENGTH,
    WORDS,
    Counter,
    alarm,
    counter_value,
    function_switches,
    gain_switch,
    word_value,
)
from ldcnd.drives.smartstep.parameters import (
    PARAMETERS,
    PN000,
    Parameter,
    find_parameter,
    unit_number,
)
from ldcnd.drives.smartstep.profiles import EepromWrite, SmartStepProfile
from ldcnd.drives.smartstep.transfer import plan_writes
from ldcnd.drives.smartstep.unit_numbers import UnitNumbers
from ldcnd.drives.smartstep.words import Words
from ldcnd.log import get_logger

log = get_logger("smartstep")

EEPROM_ATTEMPTS = 3
"""Maximum number of writes for one request, each after a read-back that shows the old value."""

COUNTERS = {CounterName.COMMAND: Counter.COMMAND, CounterName.FEEDBACK: Counter.FEEDBACK}


class UnitParameters(ParameterAccess):
    """See `ParameterAccess`."""

    def __init__(
        self,
        words: Words,
        profile: SmartStepProfile,
        ledger: EepromLedger | None,
        numbers: UnitNumbers,
        wrote: Callable[[ParameterValue, Memory], None] = lambda _value, _memory: None,
        may_have_written: Callable[[str, int, Memory], None] = lambda _label, _value, _memory: None,
    ) -> None:
        """Prepare the access; sends nothing.

        Args:
            words: the drive.
            profile: how it is taken to behave.
            ledger: where writes of EEPROM are counted; without one there are none.
            numbers: those of all drives of its line.
            wrote: called with a parameter that was written, or holds what was to be written, and into which memory.
            may_have_written: called with the label of a parameter, a value and a memory when it is unknown whether the
                drive has taken the value.
        """
        self._words = words
        self._profile = profile
        self._ledger = ledger
        self._numbers = numbers
        numbers.enter(words)
        self._wrote = wrote
        self._may_have_written = may_have_written

    @property
    def _axis(self) -> str:
        return self._words.axis

    def _find(self, text: str, *, unlisted: bool) -> Parameter:
        """Return the parameter with this number or name.

        Raises:
            ValueOutOfRange: there is none, or the manual does not list it and unlisted ones were not requested.
        """
        found = find_parameter(text)
        if found and (unlisted or found in PARAMETERS):
            return found
        raise ValueOutOfRange(
            f"axis {self._axis}: the manual lists no parameter {text!r}",
            axis=self._axis,
            value=text,
            remedy=Remedy("{}, or allow unlisted ones", step("list_parameters")),
        )

    @override
    def known(self) -> tuple[ParameterInfo, ...]:
        return tuple(map(parameter_info, PARAMETERS))

    @override
    async def read(self, parameter: str, *, unlisted: bool = False) -> ParameterValue:
        return await self._read(self._find(parameter, unlisted=unlisted))

    async def _read(self, parameter: Parameter) -> ParameterValue:
        active = await self._words.read(parameter.ram_address)
        stored = await self._words.read(parameter.eeprom_address)
        return self._value(parameter, active, stored)

    @override
    async def read_all(self) -> tuple[ParameterValue, ...]:
        values = []
        for parameter in PARAMETERS:
            try:
                values.append(await self._read(parameter))
            except AddressRefused:
                log.info("parameter not there", axis=self._axis, parameter=parameter.label)
        return tuple(values)

    @override
    async def facts(self) -> DriveFacts:
        words = self._words
        return DriveFacts(
            driver_type=await words.read(Register.DRIVER_TYPE),
            software_version=await words.read(Register.SOFTWARE_VERSION),
            unit=words.unit,
            gain_switch=gain_switch(await words.read(Register.GAIN_SWITCH)),
            switches=tuple(each.name or "" for each in function_switches(await words.read(Register.FUNCTION_SWITCHES))),
        )

    @override
    async def plan(self, request: PlanParameters) -> PlannedParameters:
        return plan_writes(request, await self.read_all(), await self.facts())

    @override
    async def write(self, request: WriteParameter) -> Written:
        parameter = self._find(request.parameter, unlisted=request.unlisted)
        gives_number = parameter.number == PN000.number
        alone: AbstractAsyncContextManager[None] = self._numbers.changing if gives_number else nullcontext()
        try:
            async with alone:
                written = await self._write(parameter, request)
        except DataRefused as refused:
            raise _out_of_range(self._axis, parameter, request.value, refused) from refused
        except BusError:
            self._may_have_written(parameter.label, request.value, request.memory)
            raise
        self._wrote(written.value, request.memory)
        return written

    async def _write(self, parameter: Parameter, request: WriteParameter) -> Written:
        before = await self._read(parameter)
        await self._check_unit(parameter, before, request)
        if request.memory is Memory.RAM:
            if before.active == request.value:
                return Written(before, written=False)
            await self._words.ask(write_ram(self._words.unit, parameter, request.value))
        else:
            self._check_eeprom()
            if before.stored == request.value:
                return Written(before, written=False, remarks=_pending(parameter, before))
            await self._write_eeprom(parameter, before.stored, request.value)
        after = await self._read(parameter)
        # an acknowledgement repeats what was sent, not what is held (manual 2.2, example 2)
        held = after.active if request.memory is Memory.RAM else after.stored
        if held != request.value:
            raise DriveFault(
                f"axis {self._axis}: {parameter.label} reads {held} after {request.value} was written to"
                f" {request.memory.upper()}",
                axis=self._axis,
                value=request.value,
                remedy="the memory may be worn out, or the drive in a state that forbids the change",
            )
        log.info("parameter written", axis=self._axis, parameter=parameter.label, memory=request.memory.value)
        return Written(after, written=True, remarks=self._remarks(parameter, after, request.memory))

    # -- EEPROM ------------------------------------------------------------------------------------------------------

    async def _write_eeprom(self, parameter: Parameter, old: int, value: int) -> None:
        """Bring a value into EEPROM; the ledger counts exactly what the drive has carried out.

        Raises:
            OutcomeUnknown: every write got lost, or the last one cannot be read back; then it stays counted.
        """
        for _ in range(EEPROM_ATTEMPTS):
            if await self._written_once(parameter, old, value):
                return
        raise OutcomeUnknown(
            f"axis {self._axis}: {parameter.label} still holds {old} after {EEPROM_ATTEMPTS} writes",
            axis=self._axis,
            value=value,
            remedy="find the cause of the line's losses before trying again",
        )

    async def _written_once(self, parameter: Parameter, old: int, value: int) -> bool:
        ledger = self._required_ledger()
        await self._words.identify()  # what this loses was not a write
        await ledger.enter(self._axis, parameter.label, self._profile.unit.eeprom_budget)
        try:
            await self._words.ask(write_eeprom(self._words.unit, parameter, value))
        except (DriveFault, RequestRefused, BusDown, BusBusy):
            await ledger.withdraw(self._axis, parameter.label)  # declined, or never sent
            raise
        except (OutcomeUnknown, BadReply):
            held = await self._words.read_back(parameter.eeprom_address)
            if held == old:
                await ledger.withdraw(self._axis, parameter.label)
            # a third value was written, too: the comparison afterwards says that it is not the one that was meant
            return held != old
        return True

    @override
    async def restart_eeprom_count(self, writes: int) -> int:
        previous = await self._required_ledger().restart(self._axis, writes)
        log.warning("EEPROM count restarted", axis=self._axis, previous=previous, total=writes)
        return previous

    @property
    @override
    def eeprom_writes(self) -> int | None:
        ledger = self._ledger
        return ledger.total(self._axis) if ledger and ledger.is_known(self._axis) else None

    def _required_ledger(self) -> EepromLedger:
        if self._ledger is None:
            raise NotSupported(
                f"axis {self._axis}: EEPROM is not written without a ledger of its wear",
                axis=self._axis,
                remedy="configure state_dir",
            )
        return self._ledger

    # -- checks ------------------------------------------------------------------------------------------------------

    def _check_eeprom(self) -> None:
        if self._profile.unit.eeprom_write is EepromWrite.DENY:
            raise NotSupported(
                f"axis {self._axis}: the configuration forbids writing EEPROM",
                axis=self._axis,
                value="eeprom_write",
                remedy="write RAM",
            )
        self._required_ledger()

    async def _check_unit(self, parameter: Parameter, before: ParameterValue, request: WriteParameter) -> None:
        """Refuse to change the unit number by the way, or to one that is taken (manual 2.2 (6))."""
        if parameter.number != PN000.number:
            return
        unit = unit_number(request.value)
        # the other digits of Pn000 may be set without that
        if unit == unit_number(before.stored if request.memory is Memory.EEPROM else before.active):
            return
        if request.memory is Memory.RAM:
            raise WrongState(
                f"axis {self._axis}: a unit number in RAM may cut the drive off and is lost at power-off",
                axis=self._axis,
                value=request.value,
                remedy="write it to EEPROM",
            )
        if request.confirm_unit != unit:
            raise WrongState(
                f"axis {self._axis}: from its next power-on on the drive would be unit {unit}, not {self._words.unit}",
                axis=self._axis,
                value=request.value,
                remedy=f"send confirm_unit {unit}, and change the configuration before the power cycle",
            )
        await self._require_free(unit)

    async def _require_free(self, unit: int) -> None:
        """Refuse a unit number that another drive of the line has or gets, or that would make this one jam the others.

        Raises:
            WrongState: the number is taken, configured or not, or it cannot be read whether it is; or it is 0 and the
                drive is not alone on its line.
        """
        reason = self._numbers.objection(self._axis, unit, await self._numbers.stored_by_others(self._axis))
        if not reason and unit != self._words.unit and await self._words.answers(unit):
            reason = f"a drive answers to unit number {unit} on this line, although no axis is configured for it"
        if not reason:
            return
        raise WrongState(
            f"axis {self._axis}: {reason}", axis=self._axis, value=unit, remedy="choose a free unit number"
        )

    # -- counters, alarms, monitors ------------------------------------------------------------------------------------

    @override
    async def clear_counter(self, counter: CounterName) -> ClearedCounter:
        return await clear_counter(self._words, COUNTERS[counter])

    @override
    async def alarms(self) -> tuple[AlarmEntry, tuple[AlarmEntry, ...]]:
        present = _entry(await self._words.read(Register.PRESENT_ALARM))
        history = [_entry(await self._words.read(Register.ALARM_HISTORY + place)) for place in range(HISTORY_LENGTH)]
        return present, tuple(history)

    @override
    async def monitors(self, names: tuple[MonitorName, ...]) -> tuple[MonitorValue, ...]:
        values = []
        for name in names or tuple(MonitorName):
            try:
                values.append(await self._monitor(name))
            except AddressRefused:
                log.info("monitor not there", axis=self._words.axis, monitor=name.value)
        return tuple(values)

    async def _monitor(self, name: MonitorName) -> MonitorValue:
        if name in MONITOR_COUNTERS:
            value = await read_counter(self._words, MONITOR_COUNTERS[name])
            return counter_value(name, value.signed, resolved=value.resolved)
        return word_value(name, await self._words.read(WORDS[name].address), self._profile)

    # -- results -----------------------------------------------------------------------------------------------------

    def _value(self, parameter: Parameter, active: int, stored: int) -> ParameterValue:
        ledger = self._ledger
        return ParameterValue(
            parameter=parameter.label,
            name=parameter.name,
            active=active,
            stored=stored,
            eeprom_writes=ledger.writes(self._axis, parameter.label) if ledger else None,
            eeprom_total=self.eeprom_writes,
        )

    def _remarks(self, parameter: Parameter, value: ParameterValue, memory: Memory) -> tuple[str, ...]:
        remarks = list(_pending(parameter, value))
        if memory is Memory.RAM and parameter.power_cycle:
            remarks = [f"{parameter.label} is said to be taken over at power-on, when RAM is lost: write EEPROM"]
        if memory is Memory.EEPROM and (value.eeprom_total or 0) >= WARNING_WRITES:
            remarks.append(f"{value.eeprom_total} of {EEPROM_LIFE} EEPROM writes are spent")
            log.warning("EEPROM wears", axis=self._axis, parameter=parameter.label, writes=value.eeprom_total)
        return tuple(remarks)


def parameter_info(parameter: Parameter) -> ParameterInfo:
    """Return what is known of a parameter."""
    facts = [fact for fact in (parameter.limits, parameter.unit) if fact]
    limits = parameter.limits.value if parameter.limits else None
    return ParameterInfo(
        parameter=parameter.label,
        name=parameter.name,
        unit=parameter.unit.value if parameter.unit else None,
        lowest=limits.lowest if limits else None,
        highest=limits.highest if limits else None,
        default=parameter.default,
        digits=parameter.nibbles,
        digit_meanings=tuple(
            DigitInfo(
                digit=each.place,
                title=each.title,
                values={f"{value:X}": text for value, text in each.values.items()},
                confidence=each.confidence.value,
            )
            for each in parameter.digits
        ),
        power_cycle=parameter.power_cycle,
        confidence=facts[0].confidence.value if facts else None,
    )


def _out_of_range(axis: str, parameter: Parameter, value: int, refused: DataRefused) -> DataRefused:
    """Return a drive's refusal of a value with the range that is known; the drive alone decides."""
    known = parameter.limits.value if parameter.limits else None
    if known is None or known.lowest <= value <= known.highest:
        return refused
    nearest = known.lowest if value < known.lowest else known.highest
    return DataRefused(
        f"axis {axis}: {parameter.label} {value}: the drive refuses it; it takes {known.lowest} to {known.highest}",
        axis=axis,
        value=value,
        limit=nearest,
        nearest=nearest,
        remedy=f"write {known.lowest} to {known.highest}",
    )


def _pending(parameter: Parameter, value: ParameterValue) -> tuple[str, ...]:
    if not value.differs:
        return ()
    return (
        f"{parameter.label}: RAM {value.active}, EEPROM {value.stored}: at the next power-on {value.stored} is used",
    )


def _entry(word: int) -> AlarmEntry:
    known = alarm(word)
    return AlarmEntry(code=known.code, text=known.text, kind=known.kind.value)
