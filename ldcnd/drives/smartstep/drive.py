"""One SmartStep as a `Drive`: read over its line, moved by pulses and inputs that no command can replace.

Its state follows from what it shows: RUN closes the loop, an alarm opens it, the speed feedback tells whether it moves.
Source: manual, introduction ("Omission": no command enables, moves, or resets); 3.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from typing_extensions import override

from ldcnd.contract.catalogue import verbs_for
from ldcnd.contract.commands import Capability
from ldcnd.contract.parameters import Memory, ParameterValue
from ldcnd.contract.samples import MonitorName, TelemetryItem
from ldcnd.drives.driver import (
    AxisReading,
    AxisSpec,
    Fault,
    PollsItself,
    ReadingListeners,
)
from ldcnd.drives.parameter_access import MonitorValue, ParameterAccess
from ldcnd.drives.smartstep.addresses import Register
from ldcnd.drives.smartstep.ledger import EepromLedger
from ldcnd.drives.smartstep.monitors import (
    INPUT_SIGNALS,
    NO_ALARM,
    OUTPUT_SIGNALS,
    R7D_AP,
    SPEED_FEEDBACK,
    AlarmCode,
    AlarmHistory,
    AlarmKind,
    alarm,
    alarm_is_out,
    input_levels,
    output_levels,
    run_is_on,
    signed_word,
)
from ldcnd.drives.smartstep.parameter_store import UnitParameters
from ldcnd.drives.smartstep.parameters import PARAMETERS
from ldcnd.drives.smartstep.poller import Basic, Item, Listeners, UnitPoller, UnitWords
from ldcnd.drives.smartstep.profiles import SMARTSTEP, SmartStepProfile
from ldcnd.drives.smartstep.trace import SmartStepTracer
from ldcnd.drives.smartstep.unit_numbers import UnitNumbers
from ldcnd.drives.smartstep.words import Words
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Poller, Timing
from ldcnd.log import get_logger


class ParameterAudit:
    """The expected value of each parameter of one drive, from its first reading on: whether they are what they were.

    A drive that was reset has again what its EEPROM holds; one that another program, or the handheld unit, has changed
    has something else. Only values in use are compared: those in EEPROM act from the next power-on on, and show then.
    """

    def __init__(self) -> None:
        self._held: dict[str, int] = {}
        self._stored: dict[str, int] = {}  # what this host has written to EEPROM: in use after the next power-on
        self._odd: tuple[str, int] | None = None  # not believed before it reads the same again
        self._found: dict[str, int] = {}

    @property
    def differences(self) -> str:
        """Say what differs; empty when nothing does."""
        return "; ".join(
            f"{label} is {value} and was {self._held[label]}" for label, value in sorted(self._found.items())
        )

    def read(self, place: int, value: int) -> bool:
        """Take the value in use of `PARAMETERS[place]`; return whether it has to be read again at once."""
        label = PARAMETERS[place].label
        # it was switched off and on meanwhile: what this host has stored is in use now
        if value == self._stored.get(label):
            self._held[label] = value
        if value == self._held.setdefault(label, value):
            self._found.pop(label, None)
        elif self._found.get(label) != value:
            # a late reply to another read passes for this one's only once
            if self._odd != (label, value):
                self._odd = (label, value)
                return True
            self._found[label] = value
        self._odd = None
        return False

    def wrote(self, value: ParameterValue, memory: Memory) -> None:
        """This host has written a parameter, or found there what it was to write: that is expected from now on."""
        label = value.parameter
        if memory is Memory.RAM or value.active == value.stored:  # else what was found in RAM acts on as it was
            self._held[label] = value.active
            self._found.pop(label, None)
        if memory is Memory.EEPROM:
            self._stored[label] = value.stored
        else:
            self._stored.pop(label, None)  # a reset would undo it

    def may_have_written(self, label: str, value: int, memory: Memory) -> None:
        """The reply to a write was lost: the value of before is as expected as the new one."""
        if memory is Memory.EEPROM:
            self._stored[label] = value
        else:
            self._held.pop(label, None)
            self._found.pop(label, None)


log = get_logger("smartstep")


@dataclass(frozen=True, slots=True)
class UnitSpec:
    """The configuration of one unit.

    Attributes:
        axis: name, unit number 0 to 15, model.
        profile: how the drive is taken to behave.
        rates_hz: how often each item is read.
        ledger: where writes of EEPROM are counted; without one there are none.
    """

    axis: AxisSpec
    profile: SmartStepProfile = SMARTSTEP
    rates_hz: Mapping[Item, float] = field(
        default_factory=lambda: {Basic.STATE: 1.0, Basic.VELOCITY: 1.0, Basic.POSITION: 1.0}
    )
    ledger: EepromLedger | None = None


class SmartStepAxis(PollsItself):
    """A drive at one unit number.

    Attributes:
        wires_checked: it was seen not to take its own replies for commands; False for one that has not answered yet.
    """

    parameters: ParameterAccess

    def __init__(self, spec: UnitSpec, bus: Bus, numbers: UnitNumbers) -> None:
        """Prepare the axis; sends nothing.

        Args:
            spec: what the configuration says.
            bus: the owner of its line.
            numbers: those of all drives of the line.
        """
        self.spec = spec.axis
        self.profile = spec.profile
        self.identity: str | None = None
        self.capabilities = verbs_for(Capability.PARAMETERS, Capability.TRACES)
        self.monitors = tuple(name for name in MonitorName if spec.rates_hz.get(name, 0.0) > 0)
        self.words = Words(bus, spec.axis.name, spec.axis.address, spec.profile)
        self._audit = ParameterAudit()
        self.parameters = UnitParameters(
            self.words,
            spec.profile,
            spec.ledger,
            numbers,
            self._audit.wrote,
            self._audit.may_have_written,
        )
        self.tracer = SmartStepTracer(bus, self.words, spec.profile)
        self._rates_hz = spec.rates_hz
        self._bus = bus
        self.wires_checked = True
        self._history = AlarmHistory()

    def identified(self, type_word: int, version: int) -> None:
        """Take driver type (8800H) and software version (8518H); both types of the manual have one word."""
        title = "R7D-APL or R7D-APH" if type_word == R7D_AP else f"unlisted type {type_word:04X}H"
        self.identity = f"SmartStep {title} (version {version:04X}H)"
        self.words.identified(type_word)

    @override
    def own_poller(self, start_at_s: float, listeners: ReadingListeners) -> Poller[Any]:

        def read(words: UnitWords, item: TelemetryItem, timing: Timing) -> None:
            listeners.observed(self.interpret(words), frozenset({item}), timing)

        def monitored(value: MonitorValue, timing: Timing) -> None:
            listeners.monitored(value, timing)

        def history(words: tuple[int, ...]) -> bool:
            if not self.words.is_identified:
                return False
            added = self._history.take(words)
            for word in added or ():
                known = alarm(word)
                log.warning("alarm history has grown", axis=self.spec.name, code=f"{known.code:04X}H", text=known.text)
                listeners.alarmed(fault_of(known))
            return added is None

        def audited(place: int, value: int) -> bool:
            return self.words.is_identified and self._audit.read(place, value)

        return UnitPoller(
            self._bus,
            self.spec.address,
            self.profile,
            self._rates_hz,
            start_at_s,
            Listeners(read, monitored, self.identified, listeners.missed, self._hears_itself, history, audited),
            wires_checked=self.wires_checked,
            is_lost=lambda: self.words.is_lost,
            clears=self.words.clears,
        )

    def interpret(self, latest: UnitWords) -> AxisReading:
        """Return what the latest words of the drive say together."""
        words = latest.words
        counts_per_s_per_rpm = self.profile.unit.encoder_counts_per_rev / 60.0
        present = alarm(words[Register.PRESENT_ALARM])
        out = alarm_is_out(self.profile, output_levels(words[OUTPUT_SIGNALS.address]))
        # 91 and 92 are titled alarms: whether they stop the motor is what /ALM says (manual 3, alarm and output tables)
        stops = present.kind is AlarmKind.ALARM or (present.kind is not AlarmKind.NONE and out)
        faults = []
        if present.code != NO_ALARM:
            faults.append(replace(fault_of(present), stops=stops))
        speed_rpm = signed_word(words[SPEED_FEEDBACK.address])
        return AxisReading(
            position_counts=latest.position.signed,
            # its deviation counter counts command units (manual 3, 8008H), which the electronic gear makes counts of
            following_error_counts=None,
            velocity_counts_per_s=speed_rpm * counts_per_s_per_rpm,
            # whole r/min are shown: less than half of one reads 0
            velocity_resolution_counts_per_s=counts_per_s_per_rpm / 2,
            adc_counts=None,
            enabled=run_is_on(self.profile, input_levels(words[INPUT_SIGNALS.address])) and not stops,
            profile_done=speed_rpm == 0,
            homing=False,
            faults=tuple(faults),
            altered=self._audit.differences,
            position_uncertain=latest.position.resolved,
            pieces=latest.pieces,
        )

    def _hears_itself(self) -> None:
        self.words.self_hearing = True


def fault_of(known: AlarmCode) -> Fault:
    """Return an alarm or a warning as a fault of the axis."""
    return Fault(f"alarm_{known.code:04x}", f"A.{known.code:02X}: {known.text}", hides_motion=known.unfollowed)
