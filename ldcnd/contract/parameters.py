"""Models of a drive with readable parameters: the parameters, its alarms and its identity."""

from collections.abc import Mapping
from enum import StrEnum
from typing import Annotated, Generic

from pydantic import Field

from ldcnd.contract.commands import AxisCommand, Capability, Command, CommandReply, Effect, ReplyT_co, Verb
from ldcnd.contract.frozen import LARGEST_INTEGER, Frozen
from ldcnd.contract.samples import MonitorContent, MonitorName

SLOW_S = 60.0
"""Longest wait for what takes many words with a slow drive, in seconds."""


class Memory(StrEnum):
    """Memory in which a parameter value is kept."""

    RAM = "ram"
    """The value in use; lost at power-off."""
    EEPROM = "eeprom"
    """The permanent value; the memory endures a limited number of writes."""


class CounterName(StrEnum):
    """The pulse counters of a drive."""

    COMMAND = "command"
    """Pulses that came in."""
    FEEDBACK = "feedback"
    """Pulses of the encoder."""


class DigitInfo(Frozen):
    """One of the four settings of a parameter that is read as hexadecimal digits."""

    digit: int = Field(ge=0, le=3)
    """Its place from the right: 2 is Pn000.2."""
    title: str
    """The setting that it selects."""
    values: Mapping[str, str]
    """Meanings of its values, by their hexadecimal digit; empty where they are numbers or not known."""
    confidence: str
    """Source of the statement: S the manual, X a related drive, M recollection."""


class ParameterInfo(Frozen):
    """One parameter of a drive: what is known of it, without its value."""

    parameter: str
    """Its number as the drive displays it, such as Pn100."""
    name: str
    """The manual's name."""
    unit: str | None
    """Null where it has none, or it is not known."""
    lowest: int | None
    """Lower end of the range; a hint, the drive itself refuses what it does not take."""
    highest: int | None
    """Upper end of the range; a hint."""
    default: int | None
    """Factory setting; a hint."""
    digits: bool
    """Four separate settings, to be read as hexadecimal digits."""
    digit_meanings: tuple[DigitInfo, ...] = ()
    """Descriptions of the digits, where known."""
    power_cycle: bool | None
    """A change takes effect at the next power-on only; null where it is not known."""
    confidence: str | None
    """Source of range and unit: S the manual, X a related drive, M recollection; null where nothing is known."""


class ParameterList(CommandReply):
    """The parameters of a drive, in the manual's order."""

    parameters: tuple[ParameterInfo, ...]
    """Description of each."""


class ParameterValue(Frozen):
    """The value of a parameter in both memories, as read at this moment."""

    parameter: str
    """Its number, such as Pn100."""
    name: str
    """The manual's name; empty for one that the manual does not list."""
    active: int = Field(ge=0, le=0xFFFF)
    """The value in RAM."""
    stored: int = Field(ge=0, le=0xFFFF)
    """The value in EEPROM."""
    eeprom_writes: int | None
    """How often this daemon has written it to EEPROM; null when no ledger is kept."""
    eeprom_total: int | None = None
    """EEPROM writes of the drive, all parameters together: this is what its life of 10,000 counts."""

    @property
    def differs(self) -> bool:
        """Whether the two memories differ: something was not saved, or waits for a power cycle."""
        return self.active != self.stored


class ParameterReply(CommandReply):
    """One parameter, after reading or writing it."""

    value: ParameterValue
    """The present values in both memories."""
    written: bool = False
    """A write was sent to the drive; false also for a write that found the value there already."""
    remarks: tuple[str, ...] = ()
    """Warnings, for a person."""


class DriveFacts(Frozen):
    """Facts about a drive, besides its parameters."""

    driver_type: int
    """8800H; the manual gives R7D-APL and R7D-APH the same word."""
    software_version: int
    """8518H."""
    unit: int = Field(ge=0, le=15)
    """Its unit number."""
    gain_switch: int = Field(ge=0, le=15)
    """Position of the gain rotary switch."""
    switches: tuple[str, ...]
    """Function selection switches that are on."""


class ParameterDump(CommandReply):
    """All listed parameters of a drive, read one after the other."""

    values: tuple[ParameterValue, ...]
    """Values in the manual's order; parameters that the drive does not have are left out."""
    facts: DriveFacts | None = None
    """Facts about the drive."""


class PlannedWrite(Frozen):
    """One write of a plan."""

    parameter: str
    """Parameter number, such as Pn100."""
    name: str
    """The manual's name."""
    memory: Memory
    """Memory to which the value goes."""
    before: int
    """The present value in the memory."""
    value: int
    """The new value: for Pn000 with the unit number that the drive has."""
    effective: str
    """Event at which the value takes effect, as far as is known."""
    digits: tuple[str, ...] = ()
    """The digits that change, spelled out."""


class PlannedParameters(Frozen):
    """The writes after which a drive would hold certain values."""

    writes: tuple[PlannedWrite, ...]
    """Writes in the order in which they are to be sent; none when the drive holds the values already."""
    problems: tuple[str, ...] = ()
    """Why they must not be sent."""
    remarks: tuple[str, ...] = ()
    """Warnings, for a person."""


class ParameterPlan(CommandReply):
    """The writes that give a drive certain values; nothing has been written."""

    plan: PlannedParameters
    """The writes, and the reasons against them."""


class CounterReply(CommandReply):
    """A counter after it was cleared."""

    counter: CounterName
    """Name of the counter."""
    value: int
    """Its present count, signed; 0 unless pulses have come in since."""
    remarks: tuple[str, ...] = ()
    """Warnings, for a person."""


class EepromCount(CommandReply):
    """The count of a drive's EEPROM writes after the count was restarted."""

    previous: int
    """Writes counted for the drive that was there before, all parameters together."""
    total: int
    """Writes counted for the drive that is there now."""


class AlarmEntry(Frozen):
    """One alarm code."""

    code: int = Field(ge=0, le=0xFFFF)
    """Code that the drive reports."""
    text: str
    """The manual's words."""
    kind: str
    """Kind of the entry: alarm, warning, none or unknown."""


class AlarmReport(CommandReply):
    """The present alarm and the history that the drive keeps over power-off."""

    present: AlarmEntry
    """The present alarm."""
    history: tuple[AlarmEntry, ...]
    """Ten entries, the newest first as far as is known."""


class MonitorReading(MonitorContent):
    """One monitor of a drive, read once."""

    monitor: MonitorName
    """Name of the counter."""
    high: tuple[str, ...] = ()
    """Signals whose level is high, switches that are on."""


class MonitorReport(CommandReply):
    """Monitors of a drive, read one after the other."""

    readings: tuple[MonitorReading, ...]
    """Readings in the order of the request; monitors that the drive does not have are left out."""


class ParameterCommand(AxisCommand[ReplyT_co], Generic[ReplyT_co]):
    """The base of these commands: each waits its turn behind those that take long."""

    capability = Capability.PARAMETERS
    answer_s = SLOW_S


class ListParameters(ParameterCommand[ParameterList]):
    """List what is known of the drive's parameters; sends nothing to the drive."""

    verb = Verb.LIST_PARAMETERS
    effect = Effect.QUESTION


class ReadParameter(ParameterCommand[ParameterReply]):
    """Read one parameter from both memories."""

    verb = Verb.READ_PARAMETER
    effect = Effect.QUESTION

    parameter: str
    """Its number, such as Pn100, or the manual's name in any case."""
    unlisted: bool = False
    """Allow a number that the manual does not list."""


class ReadAllParameters(ParameterCommand[ParameterDump]):
    """Read every listed parameter from both memories; takes seconds on a slow line."""

    verb = Verb.READ_ALL_PARAMETERS
    effect = Effect.QUESTION


class PlanParameters(ParameterCommand[ParameterPlan]):
    """List the writes after which a drive holds certain values, and what speaks against them; changes nothing."""

    verb = Verb.PLAN_PARAMETERS
    effect = Effect.QUESTION

    values: Mapping[str, Annotated[int, Field(ge=0, le=0xFFFF)]]
    """The wanted words, by number such as Pn100. The unit number in Pn000 is not taken from here."""
    driver_type: int | None = Field(default=None, ge=0, le=LARGEST_INTEGER)
    """8800H of the drive that the values come from; with another type, or none, there is a problem."""
    any_type: bool = False
    """Take values of another or of an unknown type of drive."""
    memory: Memory | None = None
    """RAM: for trying out, without what takes effect at power-on; EEPROM: permanent; null: permanent and in use at once
    where that is possible."""


class WriteParameter(ParameterCommand[ParameterReply]):
    """Write one parameter, in RAM unless EEPROM is named; nothing is sent when it has the value already."""

    verb = Verb.WRITE_PARAMETER

    parameter: str
    """Its number, such as Pn100, or the manual's name in any case."""
    value: int = Field(ge=0, le=0xFFFF)
    """The new value, a word without sign."""
    memory: Memory = Memory.RAM
    """RAM is lost at power-off; EEPROM endures 10,000 writes and must be requested by name."""
    unlisted: bool = False
    """Allow a number that the manual does not list."""
    confirm_unit: int | None = Field(default=None, ge=0, le=15)
    """The unit number that the drive will have after its next power-on, when this write changes it."""


class ClearCounter(ParameterCommand[CounterReply]):
    """Set a pulse counter to 0; command pulses must be stopped, and for the feedback counter the motor must stand."""

    verb = Verb.CLEAR_COUNTER

    counter: CounterName
    """Counter to clear."""


class RestartEepromCount(ParameterCommand[EepromCount]):
    """Restart the count of EEPROM writes, because the drive was replaced; nothing is sent to it."""

    verb = Verb.RESTART_EEPROM_COUNT

    writes: int = Field(default=0, ge=0, le=10_000)
    """Writes that the drive which is there now has taken already; 0 for a new one."""


class ReadAlarms(ParameterCommand[AlarmReport]):
    """Read the present alarm and the alarm history."""

    verb = Verb.READ_ALARMS
    effect = Effect.QUESTION


class ReadMonitors(ParameterCommand[MonitorReport]):
    """Read monitors once, published or not."""

    verb = Verb.READ_MONITORS
    effect = Effect.QUESTION

    monitors: tuple[MonitorName, ...] = Field(default=(), max_length=len(MonitorName))
    """Monitors to read; none stands for all."""


COMMANDS: tuple[type[Command[Frozen]], ...] = (
    ListParameters,
    ReadParameter,
    ReadAllParameters,
    PlanParameters,
    WriteParameter,
    ClearCounter,
    RestartEepromCount,
    ReadAlarms,
    ReadMonitors,
)
"""The commands of this file."""
