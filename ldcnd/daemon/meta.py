"""The rig's description of itself and its last values: answers to `get` on `meta/**` and `tele/**`."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import lru_cache, partial
from typing import Literal, TypeAlias

from ldcnd.axis.axis import AxisService
from ldcnd.axis.clock import Clock
from ldcnd.contract.catalogue import COMMANDS, shipped_schemas
from ldcnd.contract.codec import Encoding, encode
from ldcnd.contract.commands import About, Verb
from ldcnd.contract.errors import ErrorCode, MalformedRequest
from ldcnd.contract.frozen import Frozen, schema_name
from ldcnd.contract.health import BusHealth, DaemonHealth
from ldcnd.contract.history import AxisInstant, refuse_more_than, time_of
from ldcnd.contract.keys import RIG_ITSELF, Keys, matches
from ldcnd.contract.meta import AxisInfo, BusInfo, CommandInfo, CommandList, DaemonInfo, sample_units
from ldcnd.contract.plan import RigBudget
from ldcnd.contract.samples import Sample, TelemetryItem
from ldcnd.daemon.health import HealthWatch
from ldcnd.daemon.line import BusService
from ldcnd.daemon.rig import OwnedRig
from ldcnd.drives.driver import Drive
from ldcnd.line.exchange import Lane
from ldcnd.net.hand_over import Answer, Query
from ldcnd.net.publisher import Publisher

WORK_PER_STEP = 16
"""Payloads that go into an answer in one turn of the loop; to encode a sample counts for 4, a description for 16."""
SAMPLE_WORK, DESCRIPTION_WORK = 4, 16
COUNTERS_HZ = 10
"""Maximum update rate of the counters in a line's description, Hz."""
REMEMBERED = 1024
"""Encoded samples and reports that are kept at most; more keys than a rig has."""
_Part: TypeAlias = tuple[Answer, int]
"""One key of an answer, and the work that it took."""
LEVELS: Mapping[bool | None, Literal["high", "low"] | None] = {True: "high", False: "low", None: None}


class _Encoded:
    """The payloads of one key, rebuilt only when their source has changed."""

    __slots__ = ("_model", "_payloads", "_source")

    def __init__(self, source: Callable[[], object], model: Callable[[], Frozen]) -> None:
        self._source = source
        self._model = model
        self._payloads: dict[Encoding, tuple[object, bytes, str]] = {}

    def part(self, key: str, encoding: Encoding) -> _Part:
        """Return the payload as part of an answer."""
        source = self._source()
        known = self._payloads.get(encoding)
        if known and known[0] == source:
            return Answer(key, known[1], known[2]), 1
        payload, name = encode(self._model(), encoding)
        self._payloads[encoding] = source, payload, name
        return Answer(key, payload, name), DESCRIPTION_WORK


class Describing:
    """Answers queries about one rig in steps; JSON unless the selector has `?enc=msgpack`."""

    def __init__(
        self,
        rig: OwnedRig,
        keys: Keys,
        publisher: Publisher,
        daemon: Callable[[], DaemonInfo],
        configuration: Callable[[], Frozen],
        plan: RigBudget,
        health: HealthWatch,
        clock: Clock,
    ) -> None:
        self._publisher = publisher
        self._clock = clock
        self.plan = plan
        self._former_budget = keys.budget.removesuffix("budget") + "plan"
        self._health = health
        self._latest: dict[tuple[str, Encoding], tuple[Frozen, bytes, str]] = {}
        self._described: dict[str, _Encoded] = {
            keys.daemon: _Encoded(configuration, daemon),
            keys.commands: _Encoded(lambda: None, command_list),
            keys.budget: _Encoded(lambda: self.plan, lambda: self.plan),
            keys.configuration: _Encoded(configuration, configuration),
        }
        for bus in rig.buses:
            self._described[keys.bus(bus.bus.settings.name)] = _Encoded(
                partial(self._bus_source, bus), partial(bus_info, bus)
            )
            for axis in bus.axes:
                group = next((name for name, axes in rig.groups.items() if axis.config.name in axes), None)
                self._described[keys.axis(axis.config.name)] = _Encoded(
                    partial(_axis_source, axis), partial(axis_info, bus, axis, group)
                )
        self._histories = {keys.at(name): axis for name, axis in rig.axes.items()}
        self._schemas = {keys.schema(name): text for name, text in shipped_schemas().items()}

    def on_telemetry(self, query: Query) -> Iterator[None]:
        """Answer with the last value of every key that the query covers, or where axes were."""
        if query.key.endswith("/at"):
            try:
                return _in_steps(query, self._past(query))
            except MalformedRequest as error:
                query.refuse(error)
                return iter(())
        return _in_steps(query, self._newest(query, self._publisher.last))

    def on_meta(self, query: Query) -> Iterator[None]:
        """Answer with every description that the query covers."""
        if query.key == self._former_budget:
            query.refuse(MalformedRequest("`meta/plan` is called `meta/budget` now", remedy="ask for meta/budget"))
            return iter(())
        return _in_steps(query, self._descriptions(query))

    def _descriptions(self, query: Query) -> Iterator[_Part]:
        encoding = _wanted_encoding(query)
        for key in _covered(query.key, tuple(self._described)):
            yield self._described[key].part(key, encoding)
        yield from self._newest(query, self._health.latest)
        for key in _covered(query.key, tuple(self._schemas)):
            yield Answer(key, self._schemas[key], Encoding.JSON.value), 1

    def _newest(self, query: Query, newest: Mapping[str, Sample | DaemonHealth | BusHealth]) -> Iterator[_Part]:
        """Yield what was published last on every key that the query covers."""
        encoding = _wanted_encoding(query)
        for key in _covered(query.key, tuple(newest)):
            published = newest.get(key)
            if published is None:
                continue  # withdrawn since the query came
            known = self._latest.get((key, encoding))
            if known and known[0] is published:
                yield Answer(key, known[1], known[2], published.t), 1
                continue
            if len(self._latest) >= REMEMBERED:
                self._latest.clear()
            payload, name = encode(published, encoding)
            self._latest[key, encoding] = published, payload, name
            yield Answer(key, payload, name, published.t), SAMPLE_WORK

    def _past(self, query: Query) -> Iterator[_Part]:
        """Return where every axis that the query covers was, at an instant or in a range.

        Raises:
            MalformedRequest: it names neither, or a range with more readings than an answer may have.
        """
        t, until = time_of(query.parameters.get("_time", ""), self._clock.now_ns())
        axes = {key: self._histories[key] for key in _covered(query.key, tuple(self._histories))}
        for axis in axes.values():
            refuse_more_than(axis.config.name, axis.readings.history.count(t, until))
        return self._instants(axes, t, until, _wanted_encoding(query))

    def _instants(self, axes: Mapping[str, AxisService], t: int, until: int, encoding: Encoding) -> Iterator[_Part]:
        for key, axis in axes.items():
            past = axis.readings
            found: Iterable[AxisInstant] = [past.at(t)] if t == until else past.between(t, until)
            for instant in found:
                payload, name = encode(instant, encoding)
                yield Answer(key, payload, name, instant.t), DESCRIPTION_WORK

    def _bus_source(self, bus: BusService) -> object:
        """Return what the description of a line is made of; its counters never stand still."""
        return bus.port, bus.bus.baud, bus.report, bus.problem, int(self._clock.now_s() * COUNTERS_HZ)


def _in_steps(query: Query, parts: Iterator[_Part]) -> Iterator[None]:
    """Answer with all parts; each step does a bounded amount of work."""
    work = 0
    for answer, took in parts:
        query.reply(answer.payload, answer.encoding, key=answer.key, measured_at_ns=answer.measured_at_ns)
        work += took
        if work >= WORK_PER_STEP:
            work = 0
            yield
    query.finish()


@lru_cache(maxsize=64)
def _covered(expression: str, keys: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(key for key in keys if matches(expression, key))


def _axis_source(axis: AxisService) -> object:
    """Return what the description of an axis is made of, as far as it changes."""
    driver = axis.driver
    past = axis.reference.faults
    return axis.config, driver.identity, driver.registers(), driver.adc_full_scale, axis.traces.channels, past


def bus_info(bus: BusService) -> BusInfo:
    """Describe one line."""
    statistics = bus.bus.statistics
    latency = statistics.latency
    return BusInfo(
        bus=bus.bus.settings.name,
        port=bus.port,
        baud=bus.bus.baud,
        up=bus.report is not None,
        problem=bus.problem,
        remarks=bus.report.remarks if bus.report else (),
        started_by=None if bus.report is None else "reset" if bus.report.reset else "adoption",
        modules=bus.network.modules,
        **statistics.counters(),
        replies=statistics.replies,
        wire_busy_s=statistics.wire_busy_s,
        poll_p99_s=latency[Lane.POLL].quantile_s(0.99),
        command_p99_s=latency[Lane.COMMAND].quantile_s(0.99),
        stop_p50_s=latency[Lane.STOP].quantile_s(0.5),
        stop_p99_s=latency[Lane.STOP].quantile_s(0.99),
        stop_longest_s=latency[Lane.STOP].longest_s,
    )


def axis_info(bus: BusService, axis: AxisService, group: str | None = None) -> AxisInfo:
    """Describe one axis, of a group or of none."""
    config, driver = axis.config, axis.driver
    return AxisInfo(
        axis=config.name,
        bus=bus.bus.settings.name,
        address=config.address,
        family=bus.family,
        model=config.model,
        identity=driver.identity,
        unit=config.unit,
        sample_units=sample_units(config.unit),
        counts_per_unit=config.counts_per_unit,
        units=config.unit_table,
        g_velocity=config.g_velocity,
        direction=config.direction,
        modulo=config.modulo,
        limits=config.limits,
        limit_stop=LEVELS[driver.spec.limit_stop],
        approach=config.approach.signed if config.approach else None,
        home_velocity=config.home.velocity if config.home else None,
        group=group,
        capabilities=tuple(sorted(driver.capabilities, key=list(Verb).index)),
        items=tuple(item.value for item in TelemetryItem if _publishes(driver, item)),
        adc_full_scale=driver.adc_full_scale,
        monitors=tuple(name.value for name in driver.monitors),
        trace_channels=axis.traces.channels,
        priority=config.priority,
        gains_for={kind.value: name for kind, name in config.gains_for.items()},
        registers=driver.registers(),
        past_faults=axis.reference.faults,
    )


def _publishes(driver: Drive, item: TelemetryItem) -> bool:
    match item:
        case TelemetryItem.ADC:
            return bool(driver.adc_full_scale)
        case TelemetryItem.INPUTS:
            return driver.shows_inputs
        case TelemetryItem.LATCH:
            return Verb.PROBE in driver.capabilities
        case TelemetryItem.IO | TelemetryItem.SHADOW:
            return False  # of modules, which are no axes; of observers
        case _:
            return True


def command_list() -> CommandList:
    """Describe all commands."""
    return CommandList(
        commands=tuple(
            CommandInfo(
                verb=command.verb,
                key=f"@cmd/{RIG_ITSELF if command.about is About.RIG else '<axis>'}/{command.verb}",
                summary=command.summary(),
                effect=command.effect,
                needs_lease=command.needs_lease(),
                request_schema=schema_name(command),
                reply_schema=schema_name(command.reply_model()),
            )
            for command in COMMANDS
        ),
        errors=tuple(code.value for code in ErrorCode),
        encodings=tuple(encoding.value for encoding in Encoding),
    )


def _wanted_encoding(query: Query) -> Encoding:
    return Encoding.MSGPACK if query.parameters.get("enc") == "msgpack" else Encoding.JSON
