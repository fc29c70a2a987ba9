"""Readings and states of one axis as samples, in axis units."""

from collections.abc import Callable
from typing import Any

from ldcnd.axis.scale import AxisScale
from ldcnd.axis.status import ActiveCommand, AxisStatus
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.questions import ReportShadow
from ldcnd.contract.samples import (
    CurrentCommand,
    FaultEntry,
    LatchSample,
    MonitorName,
    Quality,
    ShadowSample,
    TelemetryItem,
)
from ldcnd.drives.driver import AxisReading, Drive
from ldcnd.drives.parameter_access import MonitorValue
from ldcnd.log import get_logger
from ldcnd.net.publisher import Publisher, Topic

log = get_logger("axis")

Inputs = tuple[bool | None, bool | None, bool | None, bool | None, bool | None]
"""Reverse limit, forward limit, index, stop input, amplifier enable."""
INPUTS_NS = 1_000_000_000
"""Inputs are published when one changes, and when so long has passed."""
FaultKey = tuple[tuple[FaultEntry, ...], FaultEntry | None]


class AxisTelemetry:
    """Publishes one axis; states and faults go out when they change and at their own rate in between."""

    def __init__(self, publisher: Publisher, name: str, drive: Drive, *, adc_volts: float) -> None:
        """Take what an axis publishes with.

        Args:
            publisher: of the daemon.
            name: of the axis.
            drive: its drive.
            adc_volts: voltage at full scale of its analog input.
        """
        self._publisher = publisher
        self._name = name
        self._adc_full_scale = drive.adc_full_scale
        self._adc_volts = adc_volts
        self._shows_inputs = drive.shows_inputs
        self._position, self._velocity, self._adc, self._inputs, self._state, self._faults = (
            publisher.item(name, item)
            for item in (
                TelemetryItem.POSITION,
                TelemetryItem.VELOCITY,
                TelemetryItem.ADC,
                TelemetryItem.INPUTS,
                TelemetryItem.STATE,
                TelemetryItem.FAULT,
            )
        )
        self._latest: AxisStatus | None = None  # whose state was published, or was as published
        self._of: AxisStatus | None = None  # of which these are the fields
        self._fields: dict[str, Any] = {}
        self._published: dict[str, Any] = {}
        self._published_faults: FaultKey | None = None
        self._placed: tuple[AxisScale, AxisReading, int, int] | None = None  # what the last position was made of
        self._last_inputs: Inputs | None = None
        self._monitors: dict[MonitorName, Topic] = {}
        self._inputs_at_ns = 0

    def publish(
        self, status: AxisStatus, reading: AxisReading, asked: frozenset[TelemetryItem], t: int, t_error_ns: int
    ) -> None:
        """Publish the requested items of a reading, and the state and the inputs if they changed.

        The state comes last, so that a place that gets known is that of the reading; one that gets lost is so at once.

        Args:
            status: the state behind the reading.
            reading: what the drive shows.
            asked: the items to publish.
            t: when it was true, UTC in ns since 1970.
            t_error_ns: how far off that can be.
        """
        scale = status.scale
        fields = self._fields if status is self._of else self._fields_of(status)
        quality, due = fields["quality"], TelemetryItem.STATE in asked
        pieces, state_error_ns = reading.pieces, t_error_ns
        if pieces:  # not all that the state is made of was read just now
            state_error_ns += round(pieces.behind_s * 1e9)
        # no face may show what is read now as a place, which the state before it, of whatever run, would make of it
        if quality is not Quality.GOOD or (self._published.get("referenced", True) and not fields["referenced"]):
            self.publish_state(status, t, state_error_ns, due=due)
            due = False
        if TelemetryItem.POSITION in asked:
            self._publish_position(scale, reading, quality, t, t_error_ns)
        if TelemetryItem.VELOCITY in asked:
            velocity = reading.velocity_counts_per_s
            scaled = Quality.UNCERTAIN if reading.velocity_uncertain and quality is Quality.GOOD else quality
            self._velocity.publish(
                {
                    "t": t,
                    "t_error_ns": t_error_ns,
                    "seq": 0,
                    "quality": scaled,
                    "value": velocity / scale.counts_per_unit,
                    "unit": f"{scale.unit}/s",
                    "counts_per_s": velocity,
                    "resolution": reading.velocity_resolution_counts_per_s / abs(scale.counts_per_unit),
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
        self.publish_state(status, t, state_error_ns, due=due)

    def _publish_position(
        self, scale: AxisScale, reading: AxisReading, quality: Quality, t: int, t_error_ns: int
    ) -> None:
        self._placed = scale, reading, t, t_error_ns
        counts, lag = reading.position_counts, reading.following_error_counts
        value, turns = scale.within_turn(counts)
        if reading.position_uncertain and quality is Quality.GOOD:
            quality = Quality.UNCERTAIN
        self._position.publish(
            {
                "t": t,
                "t_error_ns": t_error_ns,
                "seq": 0,
                "quality": quality,
                "value": value,
                "unit": scale.unit,
                "turns": turns,
                "counts": counts,
                "following_error": None if lag is None else lag / scale.counts_per_unit,
            }
        )

    def publish_state(self, status: AxisStatus, t: int, t_error_ns: int = 0, *, due: bool = False) -> None:
        """Publish the state and the faults if they changed, or if they are due anyway."""
        if status is self._latest and not due:
            return
        self._latest = status
        fields = self._fields if status is self._of else self._fields_of(status)
        if self._placed and self._placed[0] is not status.scale:
            # no face may show the old number as a place that is known, which this state would make of it
            _, reading, read_at, error_ns = self._placed
            self._publish_position(status.scale, reading, fields["quality"], read_at, error_ns)
        if due or fields != self._published:
            self._published, command = fields, status.command
            self._state.publish(
                {"t": t, "t_error_ns": t_error_ns, "seq": 0, **fields, "command": command and _current(command)}
            )
        faults = (status.active_faults if status.stop else status.faults, status.first_fault)
        if due or faults != self._published_faults:
            self._published_faults = faults
            self._faults.publish(
                {
                    "t": t,
                    "t_error_ns": t_error_ns,
                    "seq": 0,
                    "quality": fields["quality"],
                    "active": faults[0],
                    "first": faults[1],
                }
            )

    def publish_stale(self, status: AxisStatus, t: int) -> None:
        """Publish the last values once more as what they are now: not measurements any more."""
        self.publish_state(status, t)  # first: see `publish`
        for topic in (self._position, self._velocity, self._adc, self._inputs, *self._monitors.values()):
            topic.publish_again(status.quality)

    def publish_monitor(self, value: MonitorValue, quality: Quality, t: int, t_error_ns: int) -> None:
        """Publish a monitor; a counter that had to be corrected is uncertain."""
        if value.resolved and quality is Quality.GOOD:
            quality = Quality.UNCERTAIN
        monitor = value.reading.monitor
        topic = self._monitors[monitor] = self._publisher.monitor(self._name, monitor)
        topic.publish(
            {
                "t": t,
                "t_error_ns": t_error_ns,
                "seq": 0,
                "quality": quality,
                **value.reading.model_dump(exclude={"monitor"}),
            }
        )

    def publish_latch(self, sample: LatchSample) -> None:
        """Publish what a probe has latched, with the next number of its topic."""
        self._publisher.item(self._name, TelemetryItem.LATCH).publish_sample(sample)

    def publish_shadow(self, report: ReportShadow) -> None:
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
        self._publisher.item(self._name, TelemetryItem.SHADOW).publish_sample(sample)

    def _fields_of(self, status: AxisStatus) -> dict[str, Any]:
        """Return the fields of the state sample of another status."""
        self._of = status
        self._fields = status.sample_fields()
        return self._fields


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
