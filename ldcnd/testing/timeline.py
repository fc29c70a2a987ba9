"""What has happened on a simulated rig, in one order: commands, states, faults of drives, and what a test let go wrong.

It is what a person reads when a test fails.
"""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from operator import attrgetter
from pathlib import Path

from ldcnd.contract.codec import decode_received
from ldcnd.contract.events import CommandEvent
from ldcnd.contract.samples import FaultSample, PositionSample, StateSample, TelemetryItem
from ldcnd.net.session import Publication, SampleKind

KEPT = 2000
SHOWN = 100
EVENT = "event"


@dataclass(frozen=True, slots=True)
class Moment:
    """One line of the timeline: when, in seconds since the rig was made, and what."""

    at_s: float
    text: str

    def __str__(self) -> str:
        """Return it as it is printed."""
        return f"{self.at_s:9.3f} s  {self.text}"


class Timeline:
    """Collects moments, and the positions for a picture; the oldest are forgotten."""

    def __init__(self, now_s: Callable[[], float], begins_ns: int) -> None:
        self._now_s = now_s
        self._begins_ns = begins_ns
        self._moments: deque[Moment] = deque(maxlen=KEPT)
        self._positions: dict[str, deque[tuple[float, float]]] = {}
        self._said: dict[tuple[str, str], str] = {}

    @property
    def moments(self) -> tuple[Moment, ...]:
        """What has happened, oldest first: events of commands are published a little later than they happen."""
        return tuple(sorted(self._moments, key=attrgetter("at_s")))

    def note(self, text: str) -> None:
        """Add something of one's own."""
        self._moments.append(Moment(self._now_s(), text))

    def take(self, sample: Publication) -> None:
        """Add what the daemon has published."""
        if sample.kind is not SampleKind.PUT:
            return
        axis, _, item = sample.key.rpartition("/tele/")[2].partition("/")
        if item == TelemetryItem.POSITION:
            position = decode_received(PositionSample, sample.payload, sample.encoding)
            self._positions.setdefault(axis, deque(maxlen=KEPT)).append((self._now_s(), position.value))
        elif item == TelemetryItem.STATE:
            state = decode_received(StateSample, sample.payload, sample.encoding)
            target = "" if state.target is None else f", target {state.target:.6g}"
            self._changed(axis, "state", f"is {state.state} and moves: {state.moving}{target}")
        elif item == TelemetryItem.FAULT:
            fault = decode_received(FaultSample, sample.payload, sample.encoding)
            names = ", ".join(each.code for each in fault.active) or "none"
            self._changed(axis, "faults", f"has faults: {names}")
        elif item == EVENT:
            event = decode_received(CommandEvent, sample.payload, sample.encoding)
            why = f": {event.reason}" if event.reason else ""
            where = "" if event.position is None else f" at {event.position:.6g}"
            who = f" by {event.client}" if event.client else ""
            moment = Moment(self._seconds(event.t), f"{event.axis} {event.verb} {event.status}{who}{where}{why}")
            self._moments.append(moment)

    def _seconds(self, at_ns: int) -> float:
        return (at_ns - self._begins_ns) / 1e9

    def _changed(self, axis: str, what: str, text: str) -> None:
        if self._said.get((axis, what)) != text:
            self._said[axis, what] = text
            self.note(f"{axis} {text}")

    def __str__(self) -> str:
        """Return the last lines, and how many are left off before them."""
        moments = self.moments
        left = [f"({len(moments) - SHOWN} earlier lines)"] if len(moments) > SHOWN else []
        return "\n".join([*left, *map(str, moments[-SHOWN:])])

    def draw(self, file: Path) -> Path | None:
        """Draw the positions over time; return the file, or None where matplotlib is not installed."""
        if not self._positions or find_spec("matplotlib") is None:
            return None
        from matplotlib.figure import Figure  # noqa: PLC0415 - an extra

        figure = Figure(figsize=(9, 1.8 * len(self._positions) + 0.6), layout="constrained")
        plots = figure.subplots(len(self._positions), 1, sharex=True, squeeze=False)
        for (axis, points), (plot,) in zip(sorted(self._positions.items()), plots, strict=True):
            times_s, values = zip(*points, strict=True)
            plot.plot(times_s, values)
            plot.set_ylabel(axis)
            for moment in self.moments[-SHOWN:]:
                if moment.text.startswith(f"{axis}: "):
                    plot.axvline(moment.at_s, color="tab:red", linewidth=0.8)
                    plot.annotate(moment.text.removeprefix(f"{axis}: "), (moment.at_s, values[-1]), fontsize=7)
        plots[-1][0].set_xlabel("s")
        figure.savefig(file)
        return file
