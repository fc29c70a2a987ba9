"""Readings and states of one axis as samples, in axis units."""

from ldcnd.daemon.axis.state import ActiveCommand, AxisTracker
from ldcnd.daemon.publish.publisher import Publisher
from ldcnd.drivers.driver import AxisReading
from ldcnd.drivers.monitor_value import MonitorValue
from ldcnd.drivers.scaling import Scale
from ldcnd.model.frozen import unchecked
from ldcnd.model.samples import (
    AdcSample,
    AxisState,
    CurrentCommand,
    FaultEntry,
    FaultSample,
    InputsSample,
    LatchSample,
    LinkState,
    MonitorSample,
    Moving,
    PositionSample,
    Quality,
    StateSample,
    TelemetryItem,
    VelocitySample,
)

StateKey = tuple[Quality, AxisState, bool, bool, Moving, LinkState, bool, bool, ActiveCommand | None, str | None]
Inputs = tuple[bool | None, bool | None, bool | None, bool | None, bool | None]
"""Reverse limit, forward limit, index, stop input, amplifier enable."""
INPUTS_NS = 1_000_000_000
"""Inputs are published when one changes, and when so long has passed."""
FaultKey = tuple[tuple[FaultEntry, ...], FaultEntry | None]

# five of each poll, of values that are checked when they come off the wire
_position_sample = unchecked(PositionSample)
_velocity_sample = unchecked(VelocitySample)
_adc_sample = unchecked(AdcSample)
_state_sample = unchecked(StateSample)
_fault_sample = unchecked(FaultSample)
_inputs_sample = unchecked(InputsSample)


class AxisTelemetry:
    """Publishes one axis; states and faults go out when they change and at their own rate in between."""

    def __init__(
        self,
        publisher: Publisher,
        tracker: AxisTracker,
        scale: Scale,
        *,
        adc_full_scale: int | None,
        adc_volts: float,
        shows_inputs: bool,
        modulo: float | None,
    ) -> None:
        self.origin_counts = 0.0
        self._publisher = publisher
        self._tracker = tracker
        self._scale = scale
        self._adc_full_scale = adc_full_scale
        self._adc_volts = adc_volts
        self._velocity_unit = f"{tracker.unit}/s"
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
        self._last_state: StateKey | None = None
        self._last_faults: FaultKey | None = None
        self._shows_inputs = shows_inputs
        self._modulo = modulo
        self._last_inputs: Inputs | None = None
        self._inputs_at_ns = 0

    def position(self, counts: float) -> float:
        """Return the position that a count of the drive stands for, in axis units, counted through all turns."""
        return self._scale.to_units(counts - self.origin_counts)

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
        """Publish what was asked for, and the state if it changed."""
        tracker, scale = self._tracker, self._scale
        quality = tracker.quality
        counts, velocity, adc = reading.position_counts, reading.velocity_counts_per_s, reading.adc_counts
        if TelemetryItem.POSITION in asked:
            lag, value, turns = reading.following_error_counts, self.position(counts), None
            if self._modulo is not None:
                value, turns = self.within_turn(value)
            topic = self._position
            topic.publish(
                _position_sample(
                    t=t,
                    t_error_ns=t_error_ns,
                    seq=topic.seq,
                    quality=quality,
                    value=value,
                    unit=tracker.unit,
                    turns=turns,
                    counts=counts,
                    following_error=None if lag is None else scale.to_units(lag),
                )
            )
        if TelemetryItem.VELOCITY in asked:
            topic = self._velocity
            topic.publish(
                _velocity_sample(
                    t=t,
                    t_error_ns=t_error_ns,
                    seq=topic.seq,
                    quality=quality,
                    value=scale.to_units(velocity),
                    unit=self._velocity_unit,
                    counts_per_s=velocity,
                )
            )
        if TelemetryItem.ADC in asked and adc is not None and self._adc_full_scale:
            full_scale = self._adc_full_scale
            topic = self._adc
            topic.publish(
                _adc_sample(
                    t=t,
                    t_error_ns=t_error_ns,
                    seq=topic.seq,
                    quality=quality,
                    counts=adc,
                    full_scale=full_scale,
                    volts=adc / full_scale * self._adc_volts,
                )
            )
        due = TelemetryItem.STATE in asked
        inputs = (
            reading.reverse_limit,
            reading.forward_limit,
            reading.index,
            reading.stop_input,
            reading.amplifier_enable,
        )
        if self._shows_inputs and (inputs != self._last_inputs or t - self._inputs_at_ns > INPUTS_NS):
            self._last_inputs, self._inputs_at_ns = inputs, t
            reverse, forward, index, stop_input, amplifier_enable = inputs
            topic = self._inputs
            topic.publish(
                _inputs_sample(
                    t=t,
                    t_error_ns=t_error_ns,
                    seq=topic.seq,
                    quality=quality,
                    reverse_limit=reverse,
                    forward_limit=forward,
                    index=index,
                    stop_input=stop_input,
                    amplifier_enable=amplifier_enable,
                )
            )
        self.state(t, t_error_ns, due=due)

    def state(self, t: int, t_error_ns: int = 0, *, due: bool = False) -> None:
        """Publish state and faults if they changed, or if they are due anyway."""
        tracker = self._tracker
        state = _state_of(tracker)
        if due or state != self._last_state:
            self._last_state = state
            self._state.publish(_sample_of_state(state, t, t_error_ns, self._state.seq))
        faults = (tracker.active_faults, tracker.first_fault)
        if due or faults != self._last_faults:
            self._last_faults = faults
            self._faults.publish(
                _fault_sample(
                    t=t,
                    t_error_ns=t_error_ns,
                    seq=self._faults.seq,
                    quality=state[0],
                    active=tracker.active_faults,
                    first=tracker.first_fault,
                )
            )

    def monitor(self, value: MonitorValue, t: int, t_error_ns: int) -> None:
        """Publish a monitor; a counter that had to be corrected is doubtful."""
        quality = self._tracker.quality
        if value.resolved and quality is Quality.GOOD:
            quality = Quality.UNCERTAIN
        topic = self._publisher.monitor(self._tracker.name, value.name)
        topic.publish(
            MonitorSample(
                t=t,
                t_error_ns=t_error_ns,
                seq=topic.seq,
                quality=quality,
                value=value.value,
                unit=value.unit,
                title=value.title,
                high=value.high,
                active=value.active,
            )
        )

    def latched(self, sample: LatchSample) -> None:
        """Publish what a probe has latched, with the next number of its topic."""
        topic = self._publisher.item(self._tracker.name, TelemetryItem.LATCH)
        topic.publish(sample.model_copy(update={"seq": topic.seq}))

    def stale(self, t: int) -> None:
        """Publish the last values once more as what they are now: not measurements any more."""
        for topic in (self._position, self._velocity, self._adc, self._inputs):
            topic.publish_again(self._tracker.quality)
        self.state(t)


def _state_of(tracker: AxisTracker) -> StateKey:
    """Return what a state sample says besides when; compared after every poll, so no model is built for it."""
    return (
        tracker.quality,
        tracker.state,
        tracker.enabled,
        tracker.referenced,
        tracker.moving,
        tracker.link,
        tracker.stop_latched,
        tracker.stop_pending,
        tracker.command,
        tracker.last_error,
    )


def _sample_of_state(known: StateKey, t: int, t_error_ns: int, seq: int) -> StateSample:
    quality, state, enabled, referenced, moving, link, stop_latched, stop_pending, command, last_error = known
    return _state_sample(
        t=t,
        t_error_ns=t_error_ns,
        seq=seq,
        quality=quality,
        state=state,
        enabled=enabled,
        referenced=referenced,
        moving=moving,
        link=link,
        stop_latched=stop_latched,
        stop_pending=stop_pending,
        command=command and _current(command),
        last_error=last_error,
    )


def _current(command: ActiveCommand) -> CurrentCommand:
    duration_s = command.duration_s
    return CurrentCommand(
        command_id=command.command_id,
        verb=command.verb,
        since=command.since_ns,
        target=command.target,
        expected_end=None if duration_s is None else command.since_ns + round(duration_s * 1e9),
    )
