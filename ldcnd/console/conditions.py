"""The condition of every axis and module of one rig, decided here and sent to pages as a value beside the daemon's own.

A page shows it and has no rule of its own. A condition changes without a sample too: positions get old, a daemon falls
silent. So it is decided again a few times a second, and goes to pages when it is another.
"""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import msgpack

from ldcnd.client.daemon_clock import DaemonClock
from ldcnd.client.network import Publication, SampleKind
from ldcnd.contract.codec import Encoding, decode_received
from ldcnd.contract.condition import SILENT_S, Condition, Place, assess, assess_module
from ldcnd.contract.errors import LdcndError
from ldcnd.contract.health import BusHealth
from ldcnd.contract.keys import Keys
from ldcnd.contract.samples import FaultSample, PositionSample, StateSample, TelemetryItem
from ldcnd.contract.samples import Sample as Measured
from ldcnd.contract.troubles import Severity, Trouble, TroubleKind

TOPIC = "condition"
"""The last chunk of the key under which a page gets the condition of an axis; no daemon publishes it."""
PERIOD_S = 0.25
"""Time between two decisions, seconds."""
LEVELS = {Severity.FINE: "", Severity.NOTICE: "warn", Severity.WRONG: "bad"}
MeasuredT = TypeVar("MeasuredT", bound=Measured)
_MODELS: dict[str, type[Measured]] = {
    TelemetryItem.STATE: StateSample,
    TelemetryItem.FAULT: FaultSample,
    TelemetryItem.POSITION: PositionSample,
}


@dataclass(slots=True)
class _Axis:
    """What came of one axis, decoded when it is needed."""

    state: Publication | None = None
    fault: Publication | None = None
    position: Publication | None = None
    shown: bytes = b""


class Conditions:
    """The conditions of the axes of one rig.

    Args:
        rig: its name.
        put: takes a sample for the pages.
        now_s: a clock, in seconds.

    Attributes:
        silence: why nothing comes from the daemon, as the console knows it; empty while it is there.
    """

    def __init__(self, rig: str, put: Callable[[Publication], None], now_s: Callable[[], float]) -> None:
        self.silence = ""
        self._keys = Keys(rig)
        self._telemetry = self._keys.telemetry("x", TelemetryItem.STATE).removesuffix(f"x/{TelemetryItem.STATE}")
        self._put = put
        self._now_s = now_s
        self._axes: dict[str, _Axis] = {}
        self._lines: dict[str, BusHealth] = {}
        self._clock = DaemonClock()
        self._heard_at_s = now_s()

    def take(self, sample: Publication) -> None:
        """Take a published sample."""
        self._heard_at_s = self._now_s()
        self._clock.follow(sample.source)
        if sample.key.startswith(self._telemetry):
            name, _, item = sample.key[len(self._telemetry) :].partition("/")
            if item in _MODELS:
                axis = self._axes.setdefault(name, _Axis())
                setattr(axis, item, sample if sample.kind is SampleKind.PUT else None)
                if item != TelemetryItem.POSITION:
                    self._show(name, axis, self._silence)  # with it on one frame: a page shows no mixture
        elif sample.key.startswith(f"{self._keys.health}/") and sample.kind is SampleKind.PUT:
            try:
                report = decode_received(BusHealth, sample.payload, sample.encoding)
            except LdcndError:
                return  # of a daemon of another version
            self._lines[report.bus] = report
            self._clock.note(report.t, self._now_s())

    def show_again(self) -> None:
        """Send all of them once more: the pages' values were put in order."""
        for axis in self._axes.values():
            axis.shown = b""
        self.show()

    def show(self) -> None:
        """Decide anew, and send what is another."""
        for name, axis in self._axes.items():
            self._show(name, axis, self._silence)
        for line in self._lines.values():
            for module in line.modules:
                condition = assess_module(module, line_up=line.up, silence=self._silence)
                self._send(module.module, self._axes.setdefault(module.module, _Axis()), condition)

    @property
    def _silence(self) -> str:
        if self.silence or self._now_s() - self._heard_at_s <= SILENT_S:
            return self.silence
        return "the daemon is silent: these are the last known values"

    def _show(self, name: str, axis: _Axis, silence: str) -> None:
        if axis.state is None and axis.position is None:
            return  # an I/O module
        self._send(name, axis, self._condition(name, axis, silence))

    def _send(self, name: str, axis: _Axis, condition: Condition) -> None:
        payload = msgpack.packb(as_payload(condition))
        if payload != axis.shown:
            axis.shown = payload
            key = f"{self._telemetry}{name}/{TOPIC}"
            self._put(Publication(key, payload, Encoding.MSGPACK, SampleKind.PUT, measured_at_ns=None))

    async def run(self) -> None:
        """Decide until cancelled."""
        while True:
            await asyncio.sleep(PERIOD_S)
            self.show()

    def _condition(self, name: str, axis: _Axis, silence: str) -> Condition:
        state, fault = self._decoded(axis.state, StateSample), self._decoded(axis.fault, FaultSample)
        position = self._decoded(axis.position, PositionSample)
        for sample in (state, position):
            if sample:
                self._clock.note(sample.t, self._now_s())
        line = next((line for line in self._lines.values() if any(each.axis == name for each in line.axes)), None)
        health = next((each for each in line.axes if each.axis == name), None) if line else None
        return assess(
            state,
            fault,
            health,
            age_s=self._clock.age_s(position.t, self._now_s()) if position else None,
            state_age_s=self._clock.age_s(state.t, self._now_s()) if state else None,
            position_quality=position.quality if position else None,
            line_up=line.up if line else None,
            silence=silence,
        )

    def _decoded(self, sample: Publication | None, model: type[MeasuredT]) -> MeasuredT | None:
        if sample is None or not self._clock.follows(sample.source):  # what a former run has said is over
            return None
        try:
            return decode_received(model, sample.payload, sample.encoding)
        except LdcndError:
            return None  # of a daemon of another version


def as_payload(condition: Condition) -> dict[str, object]:
    """Return a condition as pages get it."""
    return {
        "place": condition.place.value,
        "known": condition.place is Place.KNOWN,
        "mark": condition.mark,
        "state": condition.state,
        "live": condition.live,
        "moves": condition.moves,
        "alarm": condition.alarm.name.lower(),
        "holder": condition.holder,
        "control": condition.control,
        "troubles": [_trouble(each) for each in condition.troubles],
    }


def _trouble(trouble: Trouble) -> dict[str, str]:
    text = trouble.text
    if trouble.kind in (TroubleKind.FAULT, TroubleKind.WARNING):
        text = f"{trouble.short}: {text.partition(': ')[2]}"
    text = f"{text[:1].upper()}{text[1:]}"
    return {
        "kind": trouble.kind.name.lower(),
        "level": LEVELS[trouble.severity],
        "text": text if text.endswith((".", "?", "!")) else f"{text}.",
        "short": trouble.short,
    }
