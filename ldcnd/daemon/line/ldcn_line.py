"""From the configuration of an LDCN/NMC line to its bus and its network."""

import asyncio
from collections.abc import Mapping

from ldcnd.bus.bus import Bus
from ldcnd.bus.settings import BusSettings
from ldcnd.config.axis import AxisConfig
from ldcnd.config.bus import BusConfig
from ldcnd.config.rig import RigConfig, SimulatedLineConfig
from ldcnd.drivers.driver import AxisSpec, Gains
from ldcnd.drivers.ldcn.network import LdcnNetwork
from ldcnd.drivers.ldcn.registers import baud_at_reset
from ldcnd.drivers.line import GroupSpec, LineSpec, ModuleEntry
from ldcnd.planning.plan import servo_cycle
from ldcnd.sim.chain import Chain
from ldcnd.sim.ldcn.chain import build_chain
from ldcnd.sim.line import open_simulated_line
from ldcnd.transport.port_url import SOCKET, port_opener
from ldcnd.transport.transport import Opener

SIMULATED = "sim:"
"""A port of this kind names a simulated line instead of a device."""


def build_ldcn_line(
    config: RigConfig, settings: BusConfig, chains: Mapping[str, Chain], opener: Opener | None = None
) -> tuple[Bus, LdcnNetwork]:
    """Return the bus of a line and its network; nothing is opened yet.

    Args:
        config: the rig.
        settings: the line.
        chains: simulated lines that exist already, by name.
        opener: opens the line instead of its port.
    """
    opening_baud = settings.baud if settings.port.startswith(SOCKET) else baud_at_reset(settings.clock_hz)
    bus = Bus(
        BusSettings(
            settings.name,
            opening_baud,
            margin_s=settings.margin_ms / 1000,
            cycle=servo_cycle(settings),
            recorded_s=settings.recorder.seconds,
            recorded_bytes=settings.recorder.memory_mb * 1_000_000,
        ),
        opener or _opener(config, settings, opening_baud, chains),
    )
    return bus, LdcnNetwork(bus, tuple(_spec(axis) for axis in settings.axis), settings.baud, _line(settings))


def _spec(axis: AxisConfig) -> AxisSpec:
    gains = Gains(**axis.gains.model_dump()) if axis.gains else None
    limit_stop = axis.switch_active == "high" if axis.limit_switches == "stop" else None
    return AxisSpec(axis.name, axis.address, axis.model, gains, axis.identity, limit_stop)


def _line(settings: BusConfig) -> LineSpec:
    return LineSpec(
        start=settings.start,
        adopt_fallback=settings.adopt_fallback,
        alternate_divisors=settings.divisors == "alternate",
        clock_hz=settings.clock_hz,
        snapshot=settings.snapshot,
        modules=tuple(
            ModuleEntry(module.address, module.model, module.identity, module.name or "", module.outputs, module.rate)
            for module in settings.module
        ),
        groups=tuple(GroupSpec(group.name, group.axes, group.leader) for group in settings.group),
    )


def _opener(config: RigConfig, settings: BusConfig, baud: int, chains: Mapping[str, Chain]) -> Opener:
    if not settings.port.startswith(SIMULATED):
        return port_opener(settings.port, baud, working_baud=settings.baud, rs485=settings.transmitter)
    name = settings.port.removeprefix(SIMULATED)
    chain = chains.get(name) or _chain(next(line for line in config.sim if line.name == name))
    return lambda: open_simulated_line(chain, baud)


def _chain(line: SimulatedLineConfig) -> Chain:
    return build_chain(line.spec(starts_at_s=asyncio.get_running_loop().time()))
