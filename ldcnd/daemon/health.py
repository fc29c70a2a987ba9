"""How the rig is doing: gathers what the lines count and publishes it once a second, with axes that are not read."""

import asyncio
from collections.abc import Callable, Mapping

from ldcnd.axis.axis import AxisService
from ldcnd.axis.clock import Clock
from ldcnd.config.ports import GuestView
from ldcnd.contract.health import (
    AxisHealth,
    BusHealth,
    DaemonHealth,
    GuestHealth,
    HeartbeatHealth,
    ItemHealth,
    LaneHealth,
    StopWaitHealth,
)
from ldcnd.contract.keys import Keys
from ldcnd.contract.samples import LinkState, TelemetryItem
from ldcnd.daemon.line import BusService
from ldcnd.daemon.rig import OwnedRig
from ldcnd.line.exchange import Lane
from ldcnd.net.hand_over import Load
from ldcnd.net.publisher import Publisher, Topic
from ldcnd.version import version

PERIOD_S = 1.0
TURNS = 4
"""Minimum number of periods to measure a rate: an item polled every ten seconds is absent in most seconds."""
CLOCK_S = 0.1
"""Reports are no more punctual than this."""
LAG_LOOKS = 10
"""Number of measurements of the loop's timer lag per period."""
LANES: Mapping[Lane, str] = {lane: lane.name.lower() for lane in Lane}


class _Rate:
    """How often something comes, from the instants of the samples themselves, over as long as it takes to tell.

    Args:
        now_s: start of the measurement.
        count: samples until then.
        at_ns: when the latest of them was true.
        hz: the rate until there is one to measure.
    """

    __slots__ = ("_at_ns", "_count", "_hz", "_looked_s")

    def __init__(self, now_s: float, count: int, at_ns: int, hz: float) -> None:
        self._looked_s = now_s
        self._count = count
        self._at_ns = at_ns
        self._hz = hz

    def of(self, count: int, at_ns: int, now_s: float, least_s: float) -> float:
        """Return the rate since at least `least_s` ago; before that the one found last.

        Args:
            count: samples since the start.
            at_ns: when the latest of them was true.
            now_s: when the report is made.
            least_s: how long it takes to tell.
        """
        if count > self._count and at_ns > self._at_ns:
            hz = (count - self._count) * 1e9 / (at_ns - self._at_ns)
            if now_s - self._looked_s >= least_s - CLOCK_S and now_s > self._looked_s:
                self._hz = hz
                self._looked_s, self._count, self._at_ns = now_s, count, at_ns
            return self._hz or hz
        # what comes every five seconds is not missed before some of these have passed
        return self._hz if (now_s - self._looked_s) * self._hz < TURNS else 0.0


class HealthWatch:
    """Reports on one rig.

    Args:
        rig: what is reported on.
        keys: where.
        publisher: takes the reports, and has the counts of other publications.
        clock: as everywhere.
        load: returns how the daemon keeps up with its queries.

    Attributes:
        latest: the newest report of each key.
        stop_bounds_s: what the plan promises of stops, by line.
        heartbeat: returns how the heartbeat is; None where none is configured.
        overrides: returns the overridden interlocks of an axis, in words.
    """

    def __init__(
        self,
        rig: OwnedRig,
        keys: Keys,
        publisher: Publisher,
        clock: Clock,
        load: Callable[[], Load],
    ) -> None:
        self.latest: dict[str, DaemonHealth | BusHealth] = {}
        self.stop_bounds_s: Mapping[str, float] = {}
        self._rig = rig
        self._keys = keys
        self._publisher = publisher
        self._clock = clock
        self._load = load
        self.heartbeat: Callable[[], HeartbeatHealth | None] = lambda: None
        self.overrides: Callable[[str], tuple[str, ...]] = lambda _: ()
        self._seq = 0
        self._missed = 0
        self._busy_s: dict[str, float] = {}
        self._packets: dict[str, int] = {}
        self._topics: dict[tuple[str, TelemetryItem], Topic] = {}
        self._rates: dict[Topic, _Rate] = {}

    async def run(self) -> None:
        """Report each second until cancelled; then take the reports off the network."""
        self._note_counters()
        last_s = due_s = self._clock.now_s()
        try:
            while True:
                lag_s = 0.0
                for _ in range(LAG_LOOKS):
                    due_s += PERIOD_S / LAG_LOOKS
                    await asyncio.sleep(due_s - self._clock.now_s())
                    lag_s = max(lag_s, self._clock.now_s() - due_s)
                now_s = self._clock.now_s()
                left_out = round((now_s - due_s) / PERIOD_S)  # the next one covers half a period at least
                self._missed += left_out
                due_s += left_out * PERIOD_S
                self._report(now_s - last_s, lag_s)
                last_s = now_s
        finally:
            for key in self.latest:
                self._publisher.withdraw_report(key)

    def _report(self, period_s: float, lag_s: float) -> None:
        """Publish all reports.

        Args:
            period_s: how long ago the one before was.
            lag_s: how late a timer came since.
        """
        t = self._clock.now_ns()
        load = self._load()
        reports: dict[str, DaemonHealth | BusHealth] = {
            self._keys.health: DaemonHealth(
                t=t,
                seq=self._seq,
                loop_lag_s=lag_s,
                published=self._publisher.published,
                missed_reports=self._missed,
                waiting_queries=load.waiting,
                dropped=load.lost,
                not_kept=self._rig.not_kept_in_words,
                certificate=self._rig.certificate,
                heartbeat=self.heartbeat(),
                version=version(),
            )
        }
        for bus in self._rig.buses:
            reports[self._keys.bus_health(bus.bus.settings.name)] = self._bus(bus, t, period_s)
        for axis in self._rig.axes.values():
            if axis.tracker.status.link is LinkState.DOWN:
                axis.show()  # no poll does, and its latch and its pending stop are none of its drive's
        self._seq += 1
        self._note_counters()
        self.latest = reports
        for key, report in reports.items():
            self._publisher.publish_report(key, report, t)

    def _bus(self, service: BusService, t: int, period_s: float) -> BusHealth:
        bus, statistics = service.bus, service.bus.statistics
        name = bus.settings.name
        return BusHealth(
            t=t,
            seq=self._seq,
            bus=name,
            up=service.report is not None,
            utilisation=(statistics.wire_busy_s - self._busy_s[name]) / period_s,
            **statistics.counters(),
            lanes=tuple(_lane(service, lane) for lane in Lane),
            stop_wait=self._stop_wait(service),
            axes=tuple(self._axis(axis, service.asked_hz(axis.config.name), t) for axis in service.axes),
            modules=tuple(self._rig.modules[each].health for each in service.network.io),
            guests=(
                *(self._guest(port, guest, period_s) for port, guest in service.guests.items()),
                *(GuestHealth(port=port, problem=why) for port, why in service.unserved.items()),
            ),
        )

    def _guest(self, port: str, guest: GuestView, period_s: float) -> GuestHealth:
        return GuestHealth(
            port=port,
            since=None if guest.since_s is None else self._clock.wall_ns(guest.since_s),
            axes=tuple(sorted(guest.axes)),
            packets_hz=max(0, guest.packets - self._packets.get(port, 0)) / period_s,  # a port may be served anew
            refused=guest.refused,
        )

    def _stop_wait(self, service: BusService) -> StopWaitHealth:
        waits = service.bus.statistics.stop_wait
        return StopWaitHealth(
            bound_s=self.stop_bounds_s.get(service.bus.settings.name),
            probes=sum(waits.counts),
            p99_s=waits.quantile_s(0.99),
            longest_s=waits.longest_s,
        )

    def _axis(self, axis: AxisService, asked_hz: Mapping[TelemetryItem, float], t: int) -> AxisHealth:
        name = axis.config.name
        position = self._topic(name, TelemetryItem.POSITION)
        return AxisHealth(
            axis=name,
            link=axis.tracker.status.link,
            sample_age_s=None if position.at_ns is None else max(0.0, (t - position.at_ns) / 1e9),
            rate_wanted_hz=axis.config.rates.position,
            rate_hz=self._granted_hz(position, asked_hz.get(TelemetryItem.POSITION, 0.0)),
            faults=len(axis.tracker.status.active_faults),
            overrides=self.overrides(name),
            eeprom_writes=parameters.eeprom_writes if (parameters := axis.driver.parameters) else None,
            items=tuple(
                ItemHealth(item=item.value, asked_hz=hz, granted_hz=self._granted_hz(self._topic(name, item), hz))
                for item, hz in asked_hz.items()
            ),
        )

    def _topic(self, axis: str, item: TelemetryItem) -> Topic:
        topic = self._topics.get((axis, item))
        if topic is None:
            topic = self._topics[axis, item] = self._publisher.item(axis, item)
        return topic

    def _granted_hz(self, topic: Topic, asked_hz: float) -> float:
        """Return the recent publishing rate of an item; the configured rate until that can be measured."""
        at_ns, now_s = topic.at_ns, self._clock.now_s()
        rate = self._rates.get(topic)
        if at_ns is None:
            self._rates.pop(topic, None)
            return 0.0
        if rate is None:
            rate = self._rates[topic] = _Rate(now_s, topic.seq, at_ns, asked_hz)
        return rate.of(topic.seq, at_ns, now_s, TURNS / asked_hz if asked_hz else PERIOD_S)

    def _note_counters(self) -> None:
        self._busy_s = {bus.bus.settings.name: bus.bus.statistics.wire_busy_s for bus in self._rig.buses}
        self._packets = {port: guest.packets for bus in self._rig.buses for port, guest in bus.guests.items()}


def _lane(service: BusService, lane: Lane) -> LaneHealth:
    latency = service.bus.statistics.latency[lane]
    return LaneHealth.model_validate(
        {
            "lane": LANES[lane],
            "waiting": service.bus.waiting(lane),
            "exchanges": sum(latency.counts),
            "p50_s": latency.quantile_s(0.5),
            "p99_s": latency.quantile_s(0.99),
            "longest_s": latency.longest_s,
            "total_s": latency.total_s,
            "counts": tuple(latency.counts),
        }
    )
