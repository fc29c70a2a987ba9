"""Readings and states of one axis as samples, in axis units, and where its motions have ended."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from ldcnd.axis.state import NOT_SETTLED, ActiveCommand, AxisTracker
from ldcnd.contract.commands import ReportShadow
from ldcnd.contract.events import UNSETTLED, CommandStatus
from ldcnd.contract.samples import CurrentCommand, FaultEntry, LatchSample, Quality, ShadowSample, TelemetryItem
from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.driver import AxisReading
from ldcnd.drives.parameter_access import MonitorValue
from ldcnd.log import get_logger
from ldcnd.net.publisher import Publisher

log = get_logger("axis")

Inputs = tuple[bool | None, bool | None, bool | None, bool | None, bool | None]
"""Reverse limit, forward limit, index, stop input, amplifier enable."""
INPUTS_NS = 1_000_000_000
"""Inputs are published when one changes, and when so long has passed."""
FaultKey = tuple[tuple[FaultEntry, ...], FaultEntry | None]


class AxisTelemetry:
    """Publishes one axis; states and faults go out when they change and at their own rate in between."""

    def __init__(
        self,
        publisher: Publisher,
        tracker: AxisTracker,
        counts_per_unit: float,
        *,
        adc_full_scale: int | None,
        adc_volts: float,
        shows_inputs: bool,
        modulo: float | None,
    ) -> None:
        self.origin_counts = 0.0
        self._publisher = publisher
        self._tracker = tracker
        self._adc_full_scale = adc_full_scale
        self._adc_volts = adc_volts
        self._counts_per_unit = counts_per_unit
        self._unit, self._velocity_unit = tracker.unit, f"{tracker.unit}/s"
        self._position, self._velocity, self._adc, self._inputs, self._state, self._faults = (
            publisher.item(tracker.name, item)
            for item in (
                TelemetryItem.POSITION,
                TelemetryItem.VELOCITY,
                TelemetryItem.ADC,
                TelemetryItem.INPUTS,
                TelemetryItem.STATE,
                TelemetryItem.FAULT,
            )
        )
        self._last_state: dict[str, Any] = {}
        self._last_faults: FaultKey | None = None
        self._shows_inputs = shows_inputs
        self._modulo = modulo
        self._last_inputs: Inputs | None = None
        self._inputs_at_ns = 0

    def position(self, counts: float) -> float:
        """Return the position that a count of the drive stands for, in axis units, counted through all turns."""
        return (counts - self.origin_counts) / self._counts_per_unit

    def within_turn(self, position: float) -> tuple[float, int | None]:
        """Return a position as clients see it, and how many whole turns lie below it; None without a modulo."""
        modulo = self._modulo
        if modulo is None:
            return position, None
        turns, value = divmod(position, modulo)
        if value >= modulo:  # so rounds what lies less than a hair below a turn
            turns, value = turns + 1, 0.0
        return value, int(turns)

    def reading(self, reading: AxisReading, asked: frozenset[TelemetryItem], t: int, t_error_ns: int) -> None:
        """Publish the requested items, and the state and the inputs if they changed."""
        tracker, counts_per_unit = self._tracker, self._counts_per_unit
        if tracker.enabled and tracker.target is None and tracker.came_to_rest:
            tracker.target = self.within_turn(self.position(reading.position_counts))[0]
        shown = tracker.shown()
        quality = shown["quality"]
        if TelemetryItem.POSITION in asked:
            counts, lag, turns = reading.position_counts, reading.following_error_counts, None
            value = (counts - self.origin_counts) / counts_per_unit
            if self._modulo is not None:
                value, turns = self.within_turn(value)
            self._position.publish(
                {
                    "t": t,
                    "t_error_ns": t_error_ns,
                    "seq": 0,
                    "quality": quality,
                    "value": value,
                    "unit": self._unit,
                    "turns": turns,
                    "counts": counts,
                    "following_error": None if lag is None else lag / counts_per_unit,
                }
            )
        if TelemetryItem.VELOCITY in asked:
            velocity = reading.velocity_counts_per_s
            scaled = Quality.UNCERTAIN if reading.velocity_uncertain and quality is Quality.GOOD else quality
            self._velocity.publish(
                {
                    "t": t,
                    "t_error_ns": t_error_ns,
                    "seq": 0,
                    "quality": scaled,
                    "value": velocity / counts_per_unit,
                    "unit": self._velocity_unit,
                    "counts_per_s": velocity,
                }
            )
        adc, full_scale = reading.adc_counts, self._adc_full_scale
        if TelemetryItem.ADC in asked and adc is not None and full_scale:
            self._adc.publish(
                {
                    "t": t,
                    "t_error_ns": t_error_ns,
                    "seq": 0,
                    "quality": quality,
                    "counts": adc,
                    "full_scale": full_scale,
                    "volts": adc / full_scale * self._adc_volts,
                }
            )
        if self._shows_inputs:
            inputs = (
                reading.reverse_limit,
                reading.forward_limit,
                reading.index,
                reading.stop_input,
                reading.amplifier_enable,
            )
            if inputs != self._last_inputs or t - self._inputs_at_ns > INPUTS_NS:
                self._last_inputs, self._inputs_at_ns = inputs, t
                reverse, forward, index, stop_input, amplifier_enable = inputs
                self._inputs.publish(
                    {
                        "t": t,
                        "t_error_ns": t_error_ns,
                        "seq": 0,
                        "quality": quality,
                        "reverse_limit": reverse,
                        "forward_limit": forward,
                        "index": index,
                        "stop_input": stop_input,
                        "amplifier_enable": amplifier_enable,
                    }
                )
        self.state(t, t_error_ns, shown, due=TelemetryItem.STATE in asked)

    def state(self, t: int, t_error_ns: int = 0, shown: dict[str, Any] | None = None, *, due: bool = False) -> None:
        """Publish state, as the tracker shows it by now, and faults if they changed, or if they are due anyway."""
        shown = shown or self._tracker.shown()
        if due or shown != self._last_state:
            self._last_state, command = shown, shown["command"]
            self._state.publish(
                {"t": t, "t_error_ns": t_error_ns, "seq": 0, **shown, "command": command and _current(command)}
            )
        tracker = self._tracker
        faults = (tracker.active_faults, tracker.first_fault)
        if due or faults != self._last_faults:
            self._last_faults = faults
            self._faults.publish(
                {
                    "t": t,
                    "t_error_ns": t_error_ns,
                    "seq": 0,
                    "quality": shown["quality"],
                    "active": tracker.active_faults,
                    "first": tracker.first_fault,
                }
            )

    def monitor(self, value: MonitorValue, t: int, t_error_ns: int) -> None:
        """Publish a monitor; a counter that had to be corrected is uncertain."""
        quality = self._tracker.quality
        if value.resolved and quality is Quality.GOOD:
            quality = Quality.UNCERTAIN
        self._publisher.monitor(self._tracker.name, value.reading.monitor).publish(
            {
                "t": t,
                "t_error_ns": t_error_ns,
                "seq": 0,
                "quality": quality,
                **value.reading.model_dump(exclude={"monitor"}),
            }
        )

    def latched(self, sample: LatchSample) -> None:
        """Publish what a probe has latched, with the next number of its topic."""
        self._publisher.item(self._tracker.name, TelemetryItem.LATCH).publish_sample(sample)

    def shadow(self, report: ReportShadow) -> None:
        """Publish what an observer says."""
        sample = ShadowSample(
            t=report.t,
            t_error_ns=0,
            seq=0,
            quality=Quality.GOOD,
            learning=report.learning,
            judged=report.judged,
            figures=report.figures,
        )
        self._publisher.item(self._tracker.name, TelemetryItem.SHADOW).publish_sample(sample)

    def stale(self, t: int) -> None:
        """Publish the last values once more as what they are now: not measurements any more."""
        for topic in (self._position, self._velocity, self._adc, self._inputs):
            topic.publish_again(self._tracker.quality)
        self.state(t)


def _current(command: ActiveCommand) -> CurrentCommand:
    duration_s = command.duration_s
    return CurrentCommand(
        command_id=command.command_id,
        verb=command.verb,
        since=command.since_ns,
        target=command.target,
        expected_end=None if duration_s is None else command.since_ns + round(duration_s * 1e9),
    )


Note = Callable[[str, str, CommandStatus, str, str | None], None]
"""Takes what happened to an axis outside any command, for the events: axis, verb, status, reason, error code."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """Where a command has ended, in axis units.

    Attributes:
        position: as clients see it.
        following_error: target minus position; without a target what the drive reports, None where it does not.
        settled: whether the axis came to rest within its window in time; None for what has no target.
    """

    position: float | None
    following_error: float | None
    settled: bool | None


OnEnded = Callable[[ActiveCommand, CommandStatus, str | None, Arrival | None], None]
"""Takes a command that is over, how it ended, why when it was not done, and where; None where no reading shows it."""


class Arrivals:
    """The commands of one axis that a reading has ended, until that reading is published.

    Attributes:
        reading: the one being processed; None while none is.
        over: the commands that it has ended.
    """

    def __init__(self, config: AxisConfig, shown: Callable[[int], float], on_ended: OnEnded, note: Note) -> None:
        self.reading: AxisReading | None = None
        self._config = config
        self._counts_per_unit = config.signed_counts_per_unit
        self._shown = shown
        self._on_ended = on_ended
        self._note = note
        self.over: list[tuple[ActiveCommand, CommandStatus, str | None, Arrival]] = []

    def ended(self, command: ActiveCommand, status: CommandStatus, reason: str | None, settled: bool | None) -> None:  # noqa: FBT001 - as the tracker calls it
        """Take from the tracker that a command is over; without a reading nothing shows where."""
        reading = self.reading
        if reading is None:
            self._on_ended(command, status, reason, None)
            return
        lag = reading.following_error_counts
        if command.settling:
            lag = command.settling.target_counts - reading.position_counts
        following_error = None if lag is None else lag / self._counts_per_unit
        arrival = Arrival(self._shown(reading.position_counts), following_error, settled)
        self.over.append((command, status, reason, arrival))

    def report(self) -> None:
        """Tell of what has ended: the reading is published."""
        self.reading = None
        while self.over:
            command, status, reason, arrival = self.over.pop(0)
            self._on_ended(command, status, reason, arrival)
            if arrival.settled is False and command.settling:
                settling, unit = command.settling, self._config.unit
                window = abs(settling.window_counts / self._counts_per_unit)
                said = (
                    f"{command.verb} did not stay within {window:.6g} {unit} of its target for {settling.time_s:g} s"
                    f" in {settling.timeout_s:g} s; it is {arrival.following_error:.6g} {unit} off"
                )
                log.warning("not settled", axis=self._config.name, reason=said)
                self._note(self._config.name, UNSETTLED, CommandStatus.FAILED, said, NOT_SETTLED.code)
