"""What the rig says about itself and its last values: answers to `get` on `meta/**` and `tele/**`."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial

from ldcnd.bus.queue import Lane
from ldcnd.daemon.axis.axis import AxisService
from ldcnd.daemon.line.line import BusService
from ldcnd.daemon.line.rig import Rig
from ldcnd.daemon.publish.contract import all_schemas
from ldcnd.daemon.publish.health import HealthWatch
from ldcnd.daemon.publish.publisher import Publisher
from ldcnd.errors import ErrorCode
from ldcnd.messaging.codec import Encoding, encode
from ldcnd.messaging.keys import RIG_ITSELF, Keys, matches
from ldcnd.messaging.session import Query
from ldcnd.model.commands import CommandReply, Verb
from ldcnd.model.frozen import Frozen, schema_name
from ldcnd.model.meta import AxisInfo, BusInfo, CommandInfo, CommandList, DaemonInfo, ModuleInfo, RegisterInfo
from ldcnd.model.plan import RigPlan
from ldcnd.model.requests import REPLY_MODELS, REQUEST_MODELS
from ldcnd.model.samples import TelemetryItem
from ldcnd.model.verbs import AXIS_QUESTIONS, RIG_VERBS


class Describing:
    """Answers questions about one rig; JSON unless the selector asks for `?enc=msgpack`."""

    def __init__(
        self,
        rig: Rig,
        keys: Keys,
        publisher: Publisher,
        daemon: Callable[[], DaemonInfo],
        configuration: Callable[[], Frozen],
        plan: RigPlan,
        health: HealthWatch,
    ) -> None:
        self._rig = rig
        self._keys = keys
        self._publisher = publisher
        self._daemon = daemon
        self._configuration = configuration
        self.plan = plan
        self._health = health
        self._schemas: Mapping[str, bytes] = {keys.schema(name): text.encode() for name, text in all_schemas().items()}

    def on_telemetry(self, query: Query) -> None:
        """Answer with the last value of every key that the query covers."""
        encoding = _wanted_encoding(query)
        for key, last in self._publisher.last.items():
            if matches(query.key, key):
                payload, name = encode(last, encoding)
                query.reply(payload, name, key=key, measured_at_ns=last.t)
        query.finish()

    def on_meta(self, query: Query) -> None:
        """Answer with every description that the query covers."""
        encoding = _wanted_encoding(query)
        models: dict[str, Callable[[], Frozen]] = {
            self._keys.daemon: self._daemon,
            self._keys.commands: command_list,
            self._keys.plan: lambda: self.plan,
            self._keys.configuration: self._configuration,
        }
        for bus in self._rig.buses:
            models[self._keys.bus(bus.bus.settings.name)] = partial(bus_info, bus)
            for axis in bus.axes:
                models[self._keys.axis(axis.config.name)] = partial(axis_info, bus, axis)
        for key, model in models.items():
            if matches(query.key, key):
                payload, name = encode(model(), encoding)
                query.reply(payload, name, key=key)
        for key, report in self._health.latest.items():
            if matches(query.key, key):
                payload, name = encode(report, encoding)
                query.reply(payload, name, key=key)
        for key, text in self._schemas.items():
            if matches(query.key, key):
                query.reply(text, Encoding.JSON.value, key=key)
        query.finish()


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
        modules=tuple(ModuleInfo(**asdict(module)) for module in bus.network.modules),
        exchanges=statistics.exchanges,
        replies=statistics.replies,
        timeouts=statistics.timeouts,
        corrupt_replies=statistics.corrupt_replies,
        rejected_packets=statistics.rejected_packets,
        resent=statistics.resent,
        resynchronisations=statistics.resynchronisations,
        stray_bytes=statistics.stray_bytes,
        losses=statistics.losses,
        wire_busy_s=statistics.wire_busy_s,
        poll_p99_s=latency[Lane.POLL].quantile_s(0.99),
        command_p99_s=latency[Lane.COMMAND].quantile_s(0.99),
        stop_p50_s=latency[Lane.STOP].quantile_s(0.5),
        stop_p99_s=latency[Lane.STOP].quantile_s(0.99),
        stop_longest_s=latency[Lane.STOP].longest_s,
    )


def axis_info(bus: BusService, axis: AxisService) -> AxisInfo:
    """Describe one axis."""
    config, driver = axis.config, axis.driver
    return AxisInfo(
        axis=config.name,
        bus=bus.bus.settings.name,
        address=config.address,
        family=bus.family,
        model=config.model,
        identity=driver.identity,
        unit=config.unit,
        counts_per_unit=config.counts_per_unit,
        direction=config.direction,
        limits=config.limits,
        capabilities=tuple(sorted(driver.capabilities, key=list(Verb).index)),
        items=tuple(item.value for item in TelemetryItem if item is not TelemetryItem.ADC or driver.adc_full_scale),
        adc_full_scale=driver.adc_full_scale,
        monitors=tuple(name.value for name in driver.monitors),
        trace_channels=axis.traces.channels,
        priority=config.priority,
        registers=tuple(
            RegisterInfo(name=register.name, value=register.value, provenance=register.provenance)
            for register in driver.registers()
        ),
    )


def command_list() -> CommandList:
    """Describe all commands."""
    motions = [
        ("<axis>", verb.value, model, REPLY_MODELS.get(verb, CommandReply)) for verb, model in REQUEST_MODELS.items()
    ]
    questions = [("<axis>", verb, models.request, models.reply) for verb, models in AXIS_QUESTIONS.items()]
    rig = [(RIG_ITSELF, verb, models.request, models.reply) for verb, models in RIG_VERBS.items()]
    return CommandList(
        commands=tuple(
            CommandInfo(
                verb=verb,
                key=f"@cmd/{whom}/{verb}",
                summary=(request.__doc__ or "").strip().splitlines()[0],
                request_schema=schema_name(request),
                reply_schema=schema_name(reply),
            )
            for whom, verb, request, reply in (*motions, *questions, *rig)
        ),
        errors=tuple(code.value for code in ErrorCode),
        encodings=tuple(encoding.value for encoding in Encoding),
    )


def _wanted_encoding(query: Query) -> Encoding:
    return Encoding.MSGPACK if query.parameters.get("enc") == "msgpack" else Encoding.JSON
