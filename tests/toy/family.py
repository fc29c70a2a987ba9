"""The toy family: a stage that goes straight to where it is sent, on a line of twelve bytes each way.

Request: A5, node, operation, position and velocity (4 bytes each), sum. Reply: 5A, node, flags, both, sum.
"""

import struct
from collections.abc import Mapping, Sequence
from enum import IntEnum, IntFlag
from pathlib import Path
from typing import Any, Literal

from pydantic import Field
from typing_extensions import override

from ldcnd.contract.catalogue import verbs_for
from ldcnd.contract.commands import Capability, Verb
from ldcnd.contract.errors import BadReply, NetworkMismatch, NotSupported, ReplyTimeout
from ldcnd.contract.samples import TelemetryItem
from ldcnd.drives.axis_config import MovedAxisConfig
from ldcnd.drives.cost import LineTiming, cost_of
from ldcnd.drives.driver import (
    NO_CEILING,
    AnalogMotion,
    AxisReading,
    AxisSpec,
    Ceiling,
    CountsMotion,
    Drive,
    Gains,
    HomeCapture,
    Moves,
    PwmOutput,
    StopMode,
)
from ldcnd.drives.family import Demand, Family, OpenLine, UnopenedLine, bus_settings
from ldcnd.drives.line_config import BusConfig
from ldcnd.drives.line_plan import Poll, Urgent
from ldcnd.drives.network import BringUpReport, Network
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Exchange, PacketEffect, ReplyVerdict
from ldcnd.line.flight_recorder import Describe, WireRecord
from ldcnd.line.port_url import port_opener
from ldcnd.line.transport import Opener

BAUD = 57_600
FRAME = struct.Struct("<BBBii")
FRAME_BYTES = FRAME.size + 1
RESPONSE_S = 0.001
REQUEST, REPLY = 0xA5, 0x5A


REFUSED = frozenset(
    {
        Verb.HOME,
        Verb.TRACK,
        Verb.SET_PWM,
        Verb.SET_GAINS,
        Verb.SET_OUTPUTS,
        Verb.MOVE_ANALOG,
        Verb.MOVE_VELOCITY,
        Verb.JOG,
    }
)


class Op(IntEnum):
    STATUS, ENABLE, DISABLE, LOAD, START, STOP = range(6)


EFFECTS = {Op.STATUS: PacketEffect.READS, Op.DISABLE: PacketEffect.RELIEVES, Op.STOP: PacketEffect.RELIEVES}


class Flag(IntFlag):
    ENABLED = 1
    AT_REST = 2


def frame(head: int, node: int, code: int, position: int = 0, velocity: int = 0) -> bytes:
    body = FRAME.pack(head, node, code, position, velocity)
    return body + bytes([sum(body) & 0xFF])


def check(data: bytes) -> ReplyVerdict:
    whole = data[0] == REPLY and sum(data[:-1]) & 0xFF == data[-1]
    return ReplyVerdict.INTACT if whole else ReplyVerdict.CORRUPT


def decode(data: bytes) -> AxisReading:
    _head, _node, flags, position, velocity = FRAME.unpack(data[:-1])
    if flags & ~(Flag.ENABLED | Flag.AT_REST):
        raise BadReply(f"unknown flags {flags}")
    return AxisReading(
        position_counts=position,
        following_error_counts=0,
        velocity_counts_per_s=velocity,
        velocity_resolution_counts_per_s=1.0,
        adc_counts=None,
        enabled=bool(flags & Flag.ENABLED),
        profile_done=bool(flags & Flag.AT_REST),
        homing=False,
        faults=(),
        asked=frozenset(TelemetryItem),
    )


def exchange(node: int, op: Op, position: int = 0, velocity: int = 0) -> Exchange[AxisReading]:
    return Exchange(
        node,
        frame(REQUEST, node, op, position, velocity),
        FRAME_BYTES,
        check,
        decode,
        RESPONSE_S,
        op is not Op.START,
        effect=EFFECTS.get(op, PacketEffect.CHANGES),
    )


class ToyStage(Moves):
    """One stage."""

    def __init__(self, spec: AxisSpec, bus: Bus) -> None:
        self.spec = spec
        self.identity: str | None = None
        self.capabilities = verbs_for(Capability.MOTION, Capability.TRACES) - REFUSED
        self._bus = bus

    @override
    def reading(self, items: frozenset[TelemetryItem]) -> Exchange[AxisReading]:
        return exchange(self.spec.address, Op.STATUS)

    @override
    def quantise(self, motion: CountsMotion, most: Ceiling = NO_CEILING, *, in_motion: bool = False) -> CountsMotion:
        return motion

    @override
    def exchanges(
        self, legs: Sequence[CountsMotion], here: AxisReading, gains: Gains | None
    ) -> tuple[Exchange[Any], ...]:
        node = self.spec.address
        return (exchange(node, Op.LOAD), exchange(node, Op.START)) * len(legs)

    @override
    async def power(self, *, on: bool) -> None:
        await self._ask(Op.ENABLE if on else Op.DISABLE)

    @override
    async def load(
        self,
        motion: CountsMotion | AnalogMotion | PwmOutput,
        *,
        home: HomeCapture | None = None,
        stands_when_done: bool = True,
    ) -> None:
        if not isinstance(motion, CountsMotion) or motion.target_counts is None or home:
            raise NotSupported("a toy goes to a position and nowhere else")
        await self._ask(Op.LOAD, motion.target_counts, round(motion.velocity_counts_per_s))

    @override
    async def start(self) -> None:
        await self._ask(Op.START)

    @override
    async def stop(self, mode: StopMode) -> StopMode:
        await self._ask(Op.DISABLE if mode is StopMode.OFF else Op.STOP)
        return mode

    @override
    async def reset(self) -> None:
        await self._ask(Op.STOP)

    async def _ask(self, op: Op, position: int = 0, velocity: int = 0) -> AxisReading:
        return await self._bus.execute(exchange(self.spec.address, op, position, velocity))


class ToyNetwork(Network):
    """The stages of one line."""

    def __init__(self, bus: Bus, specs: tuple[AxisSpec, ...]) -> None:
        self._bus = bus
        self._stages = {spec.name: ToyStage(spec, bus) for spec in specs}
        self.axes: Mapping[str, Drive] = self._stages

    @override
    async def bring_up(self) -> BringUpReport:
        for name, stage in self._stages.items():
            try:
                await self._bus.execute(stage.reading(frozenset()))
            except ReplyTimeout as error:
                raise NetworkMismatch(f"axis {name} does not answer") from error
            stage.identity = "Toy stage"
            self._bus.proofs.expect(stage.spec.address, f"axis {name}", name).prove()
        return BringUpReport(BAUD, dict.fromkeys(self._stages, "Toy stage"), reset=False)


class ToyAxisConfig(MovedAxisConfig):
    """One stage."""

    model: Literal["toy-stage"]
    """The drive model."""


class ToyBusConfig(BusConfig):
    """One line of stages."""

    family: Literal["toy"]
    """The drive family on it."""
    axis: tuple[ToyAxisConfig, ...] = Field(min_length=1, max_length=9)
    """The drives that are axes."""


class ToyFamily(Family[ToyBusConfig]):
    """The toys."""

    name = "toy"
    bus_config = ToyBusConfig

    @override
    def open_lines(self, state_dir: Path | None) -> OpenLine[ToyBusConfig]:
        return open_toy_line

    @override
    def plan(self, settings: ToyBusConfig) -> Demand:
        timing = LineTiming(BAUD, BAUD, adapter_latency_s=settings.adapter_latency_ms / 1000)
        cost = cost_of(exchange(1, Op.STATUS), timing)
        polls = [
            Poll(axis.name, tuple(rates), max(rates.values()), cost, cost.mean_s)
            for axis in settings.axis
            if (rates := axis.rates.wanted_hz(adc=False))
        ]
        return Demand(timing, polls, Urgent(cost.longest_s, cost.longest_s, 0.0, settings.margin_ms / 1000))

    @override
    def describe(self, models: Mapping[int, str]) -> Describe:
        return _words


TOY = ToyFamily()


def open_toy_line(settings: ToyBusConfig, opener: Opener | None = None) -> UnopenedLine:
    bus = Bus(bus_settings(settings, BAUD), opener or port_opener(settings.port, BAUD))
    specs = tuple(AxisSpec(axis.name, axis.address, axis.model, None) for axis in settings.axis)
    return UnopenedLine(bus, ToyNetwork(bus, specs))


def _words(record: WireRecord) -> str:
    if len(record.data) != FRAME_BYTES:
        return ""
    head, node, code, position, velocity = FRAME.unpack(record.data[:-1])
    name = Op(code).name.lower() if head == REQUEST else str(Flag(code))
    return f"stage {node}: {name} {position} {velocity}"
