"""A daemon with one LDCN line and a line of two simulated SmartSteps whose recorder is watched from inside."""

import asyncio
import time
from collections.abc import AsyncIterator, Mapping
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.daemon.assembly import build_daemon
from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.smartstep.config import SmartStepAxisConfig
from ldcnd.drives.smartstep.parameters import PN000
from ldcnd.drives.smartstep.profiles import SmartStepUnitConfig
from ldcnd.drives.smartstep.trace_data import DataObject, IoObject, TracePoint
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings
from ldcnd.sim.smartstep.cable import smartstep_chain
from ldcnd.sim.smartstep.unit import SimulatedUnit
from ldcnd.sim.smartstep.variant import SimulatedVariant
from ldcnd.testing.memory_session import MemoryBroker, MemorySession
from tests.support.process import free_port
from tests.support.rig import RunningRig, openers_of, running_rig

MIXED = Path(__file__).parents[2] / "config" / "mixed.toml"
SELDOM = {"position": 0.2, "velocity": 0.2, "adc": 0.0, "state": 0.2}


class RecordWitness:
    """Keeps every point that a simulated drive has recorded, before it becomes a word.

    Attributes:
        points: of trace 1 and trace 2, in the order of time since the drive was last told to start.
    """

    def __init__(self, unit: SimulatedUnit) -> None:
        self.points: tuple[list[TracePoint], list[TracePoint]] = ([], [])
        self._sample = unit.drive._trace_point
        self._turn = 0
        unit.drive._trace_point = self._seen  # type: ignore[method-assign]  # the one place where points are made

    def _seen(self, data: DataObject, io: IoObject) -> TracePoint:
        point = self._sample(data, io)
        self.points[self._turn % 2].append(point)
        self._turn += 1
        return point


@dataclass(frozen=True, slots=True)
class TraceRig:
    """The running daemon, the drives behind it, and what unit 1 has recorded."""

    rig: RunningRig
    units: tuple[SimulatedUnit, SimulatedUnit]
    witness: RecordWitness

    def sent(self) -> list[bytes]:
        """Return what the host has sent on the SmartStep line."""
        bus = self.rig.daemon.rig.buses[1].bus
        return [record.data for record in bus.wire_log.records() if record.event is WireEvent.SENT]

    def pulses(self, units_per_s: float) -> None:
        """Change the pulses that come into unit 1."""
        self.units[0].drive.set_pulse_rate(units_per_s, asyncio.get_running_loop().time())


def trace_config(variant: SimulatedVariant, assumed: Mapping[str, object], *, loaded: bool) -> RigConfig:
    """Return the mixed rig, its SmartSteps taken to work as the variant does, or as is assumed instead.

    Args:
        variant: of the drives.
        assumed: settings of the trace that differ from it.
        loaded: poll the SmartSteps as the mixed rig does, which takes two thirds of their line, not only now and then.
    """
    config = load_config(MIXED)
    bits = variant.trigger_map
    trace = {
        "word_layout": variant.trace_word_layout,
        "byte_order": variant.trace_byte_order,
        "string_count_unit": variant.string_count_unit,
        "trigger_map": bits.model_dump(),
        **assumed,
    }

    def traced(axis: AxisConfig) -> AxisConfig:
        assert isinstance(axis, SmartStepAxisConfig)
        monitors = axis.smartstep.monitors if loaded else {}
        unit = SmartStepUnitConfig.model_validate({**axis.smartstep.model_dump(), "trace": trace, "monitors": monitors})
        rates = axis.rates if loaded else axis.rates.model_copy(update=SELDOM)
        return axis.model_copy(update={"smartstep": unit, "rates": rates})

    line, steps = config.bus
    # tests of traces poll the LDCN line only as often as keeps it up; each poll costs
    quiet = tuple(axis.model_copy(update={"rates": axis.rates.model_copy(update=SELDOM)}) for axis in line.axis)
    line = line.model_copy(update={"axis": quiet})
    steps = steps.model_copy(update={"axis": tuple(traced(axis) for axis in steps.axis)})
    return config.model_copy(update={"bus": (line, steps), "state_dir": None})


@asynccontextmanager
async def trace_rig(
    variant: SimulatedVariant | None = None,
    *,
    assumed: Mapping[str, object] = MappingProxyType({}),
    loaded: bool = False,
) -> AsyncIterator[TraceRig]:
    """Run the rig until the context ends; `feed` is unit 1, `spool` unit 2, `x` is on the LDCN line."""
    variant = variant or SimulatedVariant()
    feed, spool = units = _running_units(variant)
    witness = RecordWitness(feed)
    chains = {"steps": smartstep_chain([feed, spool])}
    config = trace_config(variant, assumed, loaded=loaded)
    async with running_rig(config, chains) as rig:
        await rig.until("feed", lambda state: state.link == "up")
        yield TraceRig(rig, units, witness)


@asynccontextmanager
async def trace_rig_over_zenoh(variant: SimulatedVariant) -> AsyncIterator[TraceRig]:
    """Run the same rig on the wall clock; daemon and client meet over real Zenoh on loopback TCP."""
    feed, spool = units = _running_units(variant)
    witness = RecordWitness(feed)
    config = trace_config(variant, {}, loaded=False)
    chains = {"steps": smartstep_chain([feed, spool])}
    endpoint = (f"tcp/127.0.0.1:{free_port()}",)
    async with (
        open_zenoh_session(ZenohSettings(listen=endpoint)) as served,
        open_zenoh_session(ZenohSettings(mode="client", connect=endpoint)) as asking,
        asyncio.TaskGroup() as group,
    ):
        daemon = build_daemon(config, served, time.time_ns, "test", openers_of(config, chains))
        running = group.create_task(daemon.run(), name="daemon")
        try:
            async with asyncio.timeout(30):
                await daemon.wait_up()
            rig = RunningRig(daemon, RigClient(asking, config.rig), MemorySession(MemoryBroker()), MemoryBroker())
            await rig.until("feed", lambda state: state.link == "up")
            yield TraceRig(rig, units, witness)
        finally:
            daemon.end()
            await running


def _running_units(variant: SimulatedVariant) -> tuple[SimulatedUnit, SimulatedUnit]:
    feed, spool = (SimulatedUnit(variant, {PN000: number << 8}) for number in (1, 2))
    for unit in (feed, spool):
        unit.drive.set_run(0.0, on=True)
    return feed, spool
