"""Health reports as Prometheus metrics: their names, labels and meaning, and how scrapers get them.

For those who monitor many rigs, through `ldcnd metrics`. Names follow the conventions of prometheus.io: base units,
`_total` for what only grows. They are served over HTTP, GET only, one request a connection, bounded in number and time:
the server of prometheus_client has a thread for each connection and waits for a slow one for ever.
"""

import asyncio
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from contextlib import asynccontextmanager
from itertools import accumulate

from prometheus_client import CollectorRegistry
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric
from prometheus_client.exposition import choose_encoder
from prometheus_client.registry import Collector

from ldcnd.contract.condition import SILENT_S, Place, assess
from ldcnd.contract.health import BusHealth, DaemonHealth
from ldcnd.contract.samples import (
    AxisState,
    FaultSample,
    LinkState,
    PositionSample,
    Quality,
    ShadowSample,
    StateSample,
)
from ldcnd.version import version

SHORTEST_LATENCY_S = 64e-6
"""Upper limit of the first bucket of a `LaneHealth`; each further one has twice the limit of the one before."""
SHADOW_FRESH_S = 60.0
"""Maximum age of what an observer says of an axis, seconds; it does so every 10 s."""
ERRORS = ("timeouts", "corrupt_replies", "rejected_packets", "resynchronisations", "stray_bytes", "losses")


class HealthCollector(Collector):
    """The latest reports of one rig; `take` and `collect` may run in different threads.

    Args:
        rig: label of every metric.
        now_s: a clock, in seconds; also called from the thread that collects.
    """

    def __init__(self, rig: str, now_s: Callable[[], float]) -> None:
        self._rig = rig
        self._now_s = now_s
        self._daemon: tuple[float, DaemonHealth] | None = None
        self._buses: dict[str, tuple[float, BusHealth]] = {}
        self._shadows: dict[str, tuple[float, ShadowSample]] = {}
        self._states: dict[str, tuple[float, StateSample]] = {}
        self._faults: dict[str, FaultSample] = {}
        self._positions: dict[str, PositionSample] = {}
        self._counts: dict[str, int] = {}

    def take(self, report: DaemonHealth | BusHealth) -> None:
        """Replace the report that came before."""
        if isinstance(report, DaemonHealth):
            self._daemon = (self._now_s(), report)
        else:
            self._buses = {**self._buses, report.bus: (self._now_s(), report)}  # a reader keeps the dict it has

    def take_shadow(self, axis: str, sample: ShadowSample) -> None:
        """Replace what an observer has said of an axis."""
        self._shadows = {**self._shadows, axis: (self._now_s(), sample)}

    def take_state(self, axis: str, sample: StateSample | FaultSample) -> None:
        """Replace what is known of the state or the faults of an axis."""
        if isinstance(sample, StateSample):
            self._states = {**self._states, axis: (self._now_s(), sample)}
        else:
            self._faults = {**self._faults, axis: sample}

    def take_position(self, axis: str, sample: PositionSample) -> None:
        """Add what an axis has travelled since the sample before, without a gap or a doubtful value between them."""
        before = self._positions.get(axis, sample)
        if sample.quality is before.quality is Quality.GOOD and sample.seq - before.seq <= 1:
            self._counts = {**self._counts, axis: self._counts.get(axis, 0) + abs(sample.counts - before.counts)}
        self._positions[axis] = sample

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics; those of reports that have stopped coming are left out."""
        since_s = self._now_s() - SILENT_S
        daemon = self._daemon[1] if self._daemon and self._daemon[0] >= since_s else None
        buses = [report for at_s, report in self._buses.values() if at_s >= since_s]
        up = GaugeMetricFamily("ldcnd_daemon_up", "1 while the daemon reports", labels=["rig"])
        up.add_metric([self._rig], 1.0 if daemon else 0.0)
        yield up
        build = GaugeMetricFamily("ldcnd_build_info", "1, with the version of this exporter", labels=["rig", "version"])
        build.add_metric([self._rig, version()], 1.0)
        yield build
        runs = GaugeMetricFamily("ldcnd_daemon_info", "1, with the version of the daemon", labels=["rig", "version"])
        if daemon and daemon.version:
            runs.add_metric([self._rig, daemon.version], 1.0)
        yield runs
        yield from self._of_daemon(daemon)
        yield from self._of_buses(buses)
        yield from self._of_lanes(buses)
        yield from self._of_axes(buses)
        yield from self._of_conditions(daemon, buses)
        yield from self._of_shadows()

    def _of_daemon(self, daemon: DaemonHealth | None) -> Iterator[Metric]:
        lag = GaugeMetricFamily("ldcnd_loop_lag_seconds", "Longest that a timer came too late lately", labels=["rig"])
        published = CounterMetricFamily("ldcnd_published", "Samples and events published", labels=["rig"])
        missed = CounterMetricFamily("ldcnd_missed_reports", "Health reports that were left out", labels=["rig"])
        waiting = GaugeMetricFamily("ldcnd_waiting_queries", "Queries without an answer yet", labels=["rig"])
        dropped = CounterMetricFamily("ldcnd_dropped", "Queries refused for being too many, news lost", labels=["rig"])
        lost = GaugeMetricFamily("ldcnd_files_not_kept", "State files that cannot be written", labels=["rig"])
        ends = GaugeMetricFamily(
            "ldcnd_certificate_expiry_timestamp_seconds",
            "When the first of the certificates that the daemon uses ends, UTC since 1970",
            labels=["rig", "certificate"],
        )
        if daemon and daemon.certificate:
            ends.add_metric([self._rig, daemon.certificate.name], daemon.certificate.ends / 1e9)
        if daemon:
            lost.add_metric([self._rig], len(daemon.not_kept))
            lag.add_metric([self._rig], daemon.loop_lag_s)
            published.add_metric([self._rig], daemon.published)
            missed.add_metric([self._rig], daemon.missed_reports)
            waiting.add_metric([self._rig], daemon.waiting_queries)
            dropped.add_metric([self._rig], daemon.dropped)
        yield from (lag, published, missed, waiting, dropped, lost, ends)

    def _of_buses(self, buses: list[BusHealth]) -> Iterator[Metric]:
        labels = ["rig", "bus"]
        up = GaugeMetricFamily("ldcnd_bus_up", "1 while the drives of a line are polled", labels=labels)
        busy = GaugeMetricFamily("ldcnd_bus_utilisation_ratio", "Share of time with bytes on the wire", labels=labels)
        exchanges = CounterMetricFamily("ldcnd_bus_exchanges", "Requests sent", labels=labels)
        resent = CounterMetricFamily("ldcnd_bus_resent", "Exchanges sent again", labels=labels)
        errors = CounterMetricFamily("ldcnd_bus_errors", "What went wrong on a line", labels=[*labels, "kind"])
        module_up = GaugeMetricFamily("ldcnd_module_up", "1 while an I/O module answers", labels=[*labels, "module"])
        for bus in buses:
            values = [self._rig, bus.bus]
            for module in bus.modules:
                module_up.add_metric([*values, module.module], float(bus.up and module.link is LinkState.UP))
            up.add_metric(values, float(bus.up))
            busy.add_metric(values, bus.utilisation)
            exchanges.add_metric(values, bus.exchanges)
            resent.add_metric(values, bus.resent)
            counts = bus.model_dump(include=set(ERRORS))
            for kind in ERRORS:
                errors.add_metric([*values, kind], counts[kind])
        yield from (up, busy, exchanges, resent, errors, module_up)

    def _of_lanes(self, buses: list[BusHealth]) -> Iterator[Metric]:
        labels = ["rig", "bus", "lane"]
        waiting = GaugeMetricFamily("ldcnd_lane_waiting", "Exchanges that wait", labels=labels)
        latency = HistogramMetricFamily("ldcnd_lane_latency_seconds", "From queueing to the reply", labels=labels)
        longest = GaugeMetricFamily("ldcnd_lane_longest_seconds", "The longest latency since the start", labels=labels)
        for bus in buses:
            for lane in bus.lanes:
                values = [self._rig, bus.bus, lane.lane]
                waiting.add_metric(values, lane.waiting)
                latency.add_metric(values, _buckets(lane.counts), lane.total_s)
                longest.add_metric(values, lane.longest_s)
        yield from (waiting, latency, longest)

    def _of_axes(self, buses: list[BusHealth]) -> Iterator[Metric]:
        labels = ["rig", "bus", "axis"]
        up = GaugeMetricFamily("ldcnd_axis_up", "1 while the drive answers", labels=labels)
        age = GaugeMetricFamily("ldcnd_axis_sample_age_seconds", "Age of the latest position", labels=labels)
        wanted = GaugeMetricFamily("ldcnd_axis_rate_wanted_hertz", "Positions asked for", labels=labels)
        rate = GaugeMetricFamily("ldcnd_axis_rate_hertz", "Positions published", labels=labels)
        faults = GaugeMetricFamily("ldcnd_axis_faults", "Faults that stand", labels=labels)
        wear = CounterMetricFamily("ldcnd_axis_eeprom_writes", "Writes of the drive's EEPROM, ever", labels=labels)
        for bus in buses:
            for axis in bus.axes:
                values = [self._rig, bus.bus, axis.axis]
                up.add_metric(values, float(axis.link is LinkState.UP))
                if axis.sample_age_s is not None:
                    age.add_metric(values, axis.sample_age_s)
                wanted.add_metric(values, axis.rate_wanted_hz)
                rate.add_metric(values, axis.rate_hz)
                faults.add_metric(values, axis.faults)
                if axis.eeprom_writes is not None:
                    wear.add_metric(values, axis.eeprom_writes)
        yield from (up, age, wanted, rate, faults, wear)

    def _of_conditions(self, daemon: DaemonHealth | None, buses: list[BusHealth]) -> Iterator[Metric]:
        labels = ["rig", "axis"]
        known = GaugeMetricFamily(
            "ldcnd_axis_place_known", "1 while the position says where the axis is", labels=labels
        )
        severity = GaugeMetricFamily(
            "ldcnd_axis_severity", "0 none, 1 minor, 2 major, 3: its values are not to be believed", labels=labels
        )
        condition = GaugeMetricFamily(
            "ldcnd_axis_condition", "1 for each thing that is to be said of an axis", labels=[*labels, "condition"]
        )
        control = GaugeMetricFamily(
            "ldcnd_axis_control", "1 with who controls or moves an axis as a label", labels=[*labels, "control"]
        )
        state_is = GaugeMetricFamily("ldcnd_axis_state", "1 for the state of an axis", labels=[*labels, "state"])
        referenced = GaugeMetricFamily("ldcnd_axis_referenced", "1 while its position is valid", labels=labels)
        latched = GaugeMetricFamily("ldcnd_axis_stop_latched", "1 from a stop until reset", labels=labels)
        pending = GaugeMetricFamily(
            "ldcnd_axis_stop_pending", "1 while a stop is not confirmed by the drive", labels=labels
        )
        lines_up = {axis.axis: bus.up for bus in buses for axis in bus.axes}
        reports = {axis.axis: axis for bus in buses for axis in bus.axes}
        since_s = self._now_s() - SILENT_S
        for axis, (at_s, state) in self._states.items():
            report = reports.get(axis)
            silence = "" if report or at_s >= since_s else "its daemon does not report any more"
            if silence and daemon:
                continue  # the daemon of now has no such axis
            age_s = report.sample_age_s if report else None
            faults = self._faults.get(axis)
            now = assess(
                state,
                faults,
                report,
                age_s=age_s,
                state_age_s=self._now_s() - at_s,
                line_up=lines_up.get(axis),
                silence=silence,
            )
            known.add_metric([self._rig, axis], float(now.place is Place.KNOWN))
            severity.add_metric([self._rig, axis], now.alarm)
            for note in dict.fromkeys((*([now.mark] if now.mark else []), *(each.short for each in now.troubles))):
                condition.add_metric([self._rig, axis, note], 1.0)
            if now.control:
                control.add_metric([self._rig, axis, now.control], 1.0)
            if silence:
                continue
            latched.add_metric([self._rig, axis], float(state.stop_latched))
            pending.add_metric([self._rig, axis], float(state.stop_pending))
            for each in AxisState if now.live else ():  # the last state of an axis that is not heard is not its state
                state_is.add_metric([self._rig, axis, each.value], float(state.state is each))
            if state.has_reference and lines_up.get(axis, True):
                referenced.add_metric([self._rig, axis], float(state.referenced))
        travelled = CounterMetricFamily(
            "ldcnd_axis_travelled_counts", "Encoder counts travelled since this exporter began", labels=labels
        )
        for axis, counts in self._counts.items():
            travelled.add_metric([self._rig, axis], counts)
        yield from (known, severity, condition, control, state_is, referenced, latched, pending, travelled)

    def _of_shadows(self) -> Iterator[Metric]:
        labels = ["rig", "axis", "figure"]
        value = GaugeMetricFamily("ldcnd_shadow_value", "Mean of a figure over the last motions", labels=labels)
        usual = GaugeMetricFamily("ldcnd_shadow_usual", "What the axis had taught", labels=labels)
        high = GaugeMetricFamily("ldcnd_shadow_high", "Above this mean there is an alarm", labels=labels)
        low = GaugeMetricFamily("ldcnd_shadow_low", "Below this mean there is an alarm", labels=labels)
        alarm = GaugeMetricFamily("ldcnd_shadow_alarm", "1 while an alarm stands", labels=labels)
        since_s = self._now_s() - SHADOW_FRESH_S
        for axis, (at_s, sample) in self._shadows.items():
            for figure in sample.figures if at_s >= since_s else ():
                values = [self._rig, axis, figure.figure]
                value.add_metric(values, figure.value)
                usual.add_metric(values, figure.usual)
                high.add_metric(values, figure.high)
                if figure.low is not None:
                    low.add_metric(values, figure.low)
                alarm.add_metric(values, float(figure.alarm))
        yield from (value, usual, high, low, alarm)


def _buckets(counts: Sequence[int]) -> list[tuple[str, float]]:
    """Return cumulative counts by upper limit; a daemon that reports no counts has none."""
    limits = [str(SHORTEST_LATENCY_S * 2.0**bucket) for bucket in range(len(counts) - 1)]
    return list(zip((*limits, "+Inf"), accumulate(counts or (0,)), strict=True))


MOST_CONNECTIONS = 32
"""One more is closed at once."""
CONNECTION_TIME_S = 5.0
"""From the connection until the answer has been taken."""
HEAD_BYTES = 8192
PATHS = frozenset({"/", "/metrics"})


@asynccontextmanager
async def metrics_server(registry: CollectorRegistry, host: str, port: int) -> AsyncIterator[int]:
    """Serve the metrics of a registry for the time of the context; yields the port.

    Raises:
        OSError: the address cannot be listened on.
    """
    open_now = 0

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        nonlocal open_now
        open_now += 1
        try:
            if open_now <= MOST_CONNECTIONS:
                async with asyncio.timeout(CONNECTION_TIME_S):
                    head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
                    writer.write(_answer(registry, head))
                    await writer.drain()
                    writer.write_eof()
                    await reader.read()
        except (TimeoutError, OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            pass  # the client gets no answer
        finally:
            open_now -= 1
            writer.transport.abort()

    server = await asyncio.start_server(serve, host, port, limit=HEAD_BYTES)
    async with server:
        yield server.sockets[0].getsockname()[1]


def _answer(registry: CollectorRegistry, head: str) -> bytes:
    request, *fields = head.split("\r\n")
    method, _, rest = request.partition(" ")
    if method not in {"GET", "HEAD"}:
        return _response("405 Method Not Allowed", "text/plain", b"")
    if rest.partition(" ")[0].partition("?")[0] not in PATHS:
        return _response("404 Not Found", "text/plain", b"see /metrics\n")
    names = dict(field.lower().split(":", 1) for field in fields if ":" in field)
    encode, kind = choose_encoder(names.get("accept", "").strip())
    return _response("200 OK", kind, b"" if method == "HEAD" else encode(registry))


def _response(status: str, kind: str, body: bytes) -> bytes:
    lines = (f"HTTP/1.1 {status}", f"Content-Type: {kind}", f"Content-Length: {len(body)}", "Connection: close", "", "")
    return "\r\n".join(lines).encode() + body
