"""The latest values that a rig publishes, and their summary; uses no terminal and no clock.

Samples are kept as they come and decoded when they are shown: a rig publishes many more than are read.
"""

from dataclasses import dataclass
from typing import TypeVar

from ldcnd.client.daemon_clock import DaemonClock
from ldcnd.client.network import Publication, SampleKind
from ldcnd.client.overview import LastOfAxis, axis_now
from ldcnd.contract.codec import decode_received
from ldcnd.contract.condition import SILENT_S, assess_module
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.health import BusHealth, DaemonHealth, LaneHealth, ModuleHealth
from ldcnd.contract.keys import Keys
from ldcnd.contract.meta import AxisInfo, DaemonInfo
from ldcnd.contract.samples import (
    AdcSample,
    FaultSample,
    PositionSample,
    StateSample,
    TelemetryItem,
    VelocitySample,
)
from ldcnd.contract.troubles import SHARED, Severity, Trouble, TroubleKind, daemon_troubles, line_troubles
from ldcnd.lab.top.glance import AxisGlance, BusGlance, ModuleGlance, RigGlance

ModelT = TypeVar("ModelT", bound=Frozen)


@dataclass(frozen=True, slots=True)
class Description:
    """The daemon's last answers to queries.

    Attributes:
        daemon: itself.
        axes: in the order in which they are shown.
    """

    daemon: DaemonInfo
    axes: tuple[AxisInfo, ...]


@dataclass(frozen=True, slots=True)
class _Kept:
    """A sample and when it came, by the loop's clock."""

    sample: Publication
    at_s: float


class RigView:
    """The known state of one rig.

    Args:
        rig: its name.
        now_s: when the view is made, by the clock whose times `take` and `glance` are given.
    """

    def __init__(self, rig: str, now_s: float) -> None:
        self._keys = Keys(rig)
        self._began_at_s = now_s
        self._clock = DaemonClock()
        self._ended = False
        self._description: Description | None = None
        self._kept: dict[str, _Kept] = {}
        self._report_before: dict[str, BusHealth] = {}

    def take(self, sample: Publication, now_s: float) -> None:
        """Keep a sample in the place of the one before."""
        is_state = sample.key.endswith(f"/{TelemetryItem.STATE}")
        if sample.kind is SampleKind.DELETE:
            self._ended |= is_state  # what is shown from now on is what it said last
            return
        self._ended &= not is_state
        if self._clock.follow(sample.source):
            self._kept, self._report_before = {}, {}  # of a former run
        before = self._kept.get(sample.key)
        if before and sample.key.startswith(f"{self._keys.health}/"):
            report = self._decoded(before, BusHealth)
            self._report_before[report.bus] = report
        self._kept[sample.key] = _Kept(sample, now_s)

    def describe(self, description: Description) -> None:
        """Take what the daemon says of its rig."""
        self._description = description

    def glance(self, now_s: float) -> RigGlance:
        """Return the rig as it is now, the most urgent first."""
        self._read_clock()
        description = self._description
        trouble = self._rig_trouble(now_s)
        axes = description.axes if description else ()
        names = description.daemon.buses if description else ()
        reports = {name: report for name in names if (report := self._latest(self._keys.bus_health(name), BusHealth))}
        rows = [self._axis(axis, reports.get(axis.bus), now_s, trouble if self._description else "") for axis in axes]
        lines = [self._bus(report) for report in reports.values()]
        modules = [_module(each, line, trouble) for line in reports.values() for each in line.modules]
        return RigGlance(
            rig=self._keys.rig,
            version=description.daemon.version if description else None,
            trouble=trouble,
            attention=daemon_troubles(self._latest(self._keys.health, DaemonHealth)),
            axes=tuple(sorted(rows, key=lambda row: -row.severity)),
            buses=tuple(sorted(lines, key=lambda line: -line.severity)),
            modules=tuple(sorted(modules, key=lambda module: -module.severity)),
        )

    def _read_clock(self) -> None:
        """Learn how late it is by the daemon's clock: it reports every second, also while nothing comes from a line."""
        if report := self._kept.get(self._keys.health):
            self._clock.note(self._decoded(report, DaemonHealth).t, report.at_s)
        for key, kept in self._kept.items():
            if key.endswith(f"/{TelemetryItem.STATE}"):
                self._clock.note(self._decoded(kept, StateSample).t, kept.at_s)

    def _rig_trouble(self, now_s: float) -> str:
        report = self._kept.get(self._keys.health)
        silent_s = now_s - (report.at_s if report else self._began_at_s)
        if self._ended:
            return "the daemon has ended: what is shown is what it said last"
        if silent_s > SILENT_S:
            return f"the daemon has been silent for {silent_s:.0f} s: what is shown is what it said last"
        return "" if self._description else "waiting for the daemon"

    def _axis(self, info: AxisInfo, line: BusHealth | None, now_s: float, silent: str) -> AxisGlance:
        keys, axis = self._keys, info.axis
        adc = self._latest(keys.telemetry(axis, TelemetryItem.ADC), AdcSample)
        last = LastOfAxis(
            self._latest(keys.telemetry(axis, TelemetryItem.STATE), StateSample),
            self._latest(keys.telemetry(axis, TelemetryItem.FAULT), FaultSample),
            self._latest(keys.telemetry(axis, TelemetryItem.POSITION), PositionSample),
            self._latest(keys.telemetry(axis, TelemetryItem.VELOCITY), VelocitySample),
        )
        now = axis_now(info, last, line, lambda t: self._clock.age_s(t, now_s), silent)
        state, position, health, condition = now.last.state, now.last.position, now.health, now.condition
        worst = next(iter(condition.troubles), None)
        news = state.last_error or "" if state else ""  # how the last command ended, where nothing is wrong
        return AxisGlance(
            axis=info.axis,
            bus=info.bus,
            unit=info.unit,
            **dict(now.seen),
            cause=cause_of(worst, info.bus),
            shown_position=condition.position(f"{position.value:.3f}" if position else None, info.unit, now.age_s),
            shown_state=condition.summary,
            target=state.command.target if state and state.command and info.describes(state) else None,
            adc_volts=adc.volts if adc else None,
            rate_hz=health.rate_hz if health else None,
            rate_wanted_hz=health.rate_wanted_hz if health else None,
            control=condition.control or None,
            severity=worst.severity if worst else Severity.FINE,
            trouble=worst.text if worst else news,
        )

    def _bus(self, report: BusHealth) -> BusGlance:
        before = self._report_before.get(report.bus)
        period_s = (report.t - before.t) / 1e9 if before else 0.0
        errors = _errors(report)
        grown = errors - _errors(before) if before else 0
        severity, trouble = Severity.FINE, ""
        if down := line_troubles(up=report.up):
            severity, trouble = down[0].severity, down[0].text
        elif grown > 0:
            severity, trouble = Severity.NOTICE, f"{grown} exchanges brought nothing to be trusted in the last second"
        poll, stop = _lane(report, "poll"), _lane(report, "stop")
        return BusGlance(
            bus=report.bus,
            cause=f"{TroubleKind.LINE_DOWN}: {report.bus}" if down else f"{report.bus}: {trouble}",
            up=report.up,
            utilisation=report.utilisation,
            exchanges_per_s=(report.exchanges - before.exchanges) / period_s if before and period_s > 0 else None,
            errors=errors,
            resent=report.resent,
            poll_p99_s=poll.p99_s if poll else None,
            stop_longest_s=stop.longest_s if stop and stop.exchanges else None,
            severity=severity,
            trouble=trouble,
        )

    def _latest(self, key: str, model: type[ModelT]) -> ModelT | None:
        kept = self._kept.get(key)
        return self._decoded(kept, model) if kept else None

    @staticmethod
    def _decoded(kept: _Kept, model: type[ModelT]) -> ModelT:
        return decode_received(model, kept.sample.payload, kept.sample.encoding)


def _module(report: ModuleHealth, line: BusHealth, silent: str) -> ModuleGlance:
    condition = assess_module(report, line_up=line.up, silence=silent)
    worst = next(iter(condition.troubles), None)
    return ModuleGlance(
        module=report.module,
        bus=line.bus,
        cause=cause_of(worst, line.bus),
        shown_state=condition.summary,
        severity=worst.severity if worst else Severity.FINE,
        trouble=worst.text if worst else "",
    )


def cause_of(worst: Trouble | None, bus: str) -> str:
    """Return what an axis has in common with others that is wrong; empty where its trouble is its own."""
    if worst is None:
        return ""
    if worst.kind is TroubleKind.LINE_DOWN:
        return f"{TroubleKind.LINE_DOWN}: {bus}"
    return str(worst.kind) if worst.kind in SHARED else ""


def _errors(report: BusHealth) -> int:
    return report.timeouts + report.corrupt_replies + report.rejected_packets


def _lane(report: BusHealth, name: str) -> LaneHealth | None:
    return next((lane for lane in report.lanes if lane.lane == name), None)
