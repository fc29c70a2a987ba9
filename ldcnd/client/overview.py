"""What is known of a rig now: the reports of its daemon, and of every axis description, samples and condition."""

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import TypeVar

from ldcnd.client.daemon_clock import DaemonClock
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.codec import decode_received
from ldcnd.contract.condition import Condition, Place, assess, assess_module
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.health import AxisHealth, BusHealth, DaemonHealth
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.samples import (
    AxisState,
    FaultSample,
    LinkState,
    Moving,
    PositionSample,
    Quality,
    Sample,
    StateSample,
    VelocitySample,
)
from ldcnd.contract.units import Dimension, quantity_text
from ldcnd.net.session import Publication, SampleKind

SampleT = TypeVar("SampleT", bound=Sample)


async def last_health(client: RigClient) -> DaemonHealth | None:
    """Return the daemon's last report about itself, or None when there is none yet."""
    reports = await client.read(client.keys.health, DaemonHealth)
    return reports[-1] if reports else None


async def last_bus_health(client: RigClient) -> list[BusHealth]:
    """Return the last report about each line and its axes."""
    return await client.read(client.keys.bus_health("*"), BusHealth)


@asynccontextmanager
async def health_reports(client: RigClient, take: Callable[[DaemonHealth | BusHealth], None]) -> AsyncIterator[None]:
    """Hand every health report to `take` for the time of the context."""

    def decode(sample: Publication) -> None:
        if sample.kind is SampleKind.DELETE:
            return
        if sample.key == client.keys.health:
            take(decode_received(DaemonHealth, sample.payload, sample.encoding))
        else:
            take(decode_received(BusHealth, sample.payload, sample.encoding))

    declaration = await client.subscribe(f"{client.keys.health}/**", decode)
    try:
        yield
    finally:
        await declaration.close()


class AxisSeen(Frozen):
    """How an axis is now, as far as that is known; null where it is not."""

    position: float | None
    """Where it is, as far as `place` says so; null before the first position."""
    quality: Quality | None
    """How much the position is worth."""
    age_s: float | None
    """Age of the position, seconds."""
    place: Place
    """Whether the position says where the axis is."""
    state: AxisState | None
    """PLCopen state."""
    link: LinkState | None
    """Whether the drive answers; that it does is known only as long as something comes from it."""
    moving: Moving
    """Whether it moves; unknown is an answer of its own and never means no."""
    velocity: float | None
    """How fast, in axis units a second; null where that is not known."""
    shown_velocity: str
    """The same in the unit that is configured for velocities; empty where that is not known."""
    rest_s: float | None
    """After how long the motion under way should have run its course, seconds; null where it has no such end."""
    condition: tuple[str, ...]
    """Everything that is to be said of it, in a few words each, the worst first."""


@dataclass(frozen=True, slots=True)
class LastOfAxis:
    """The last sample of each item of an axis; None before the first."""

    state: StateSample | None
    fault: FaultSample | None
    position: PositionSample | None
    velocity: VelocitySample | None


@dataclass(frozen=True, slots=True)
class AxisNow:
    """One axis as its daemon has shown it last.

    Attributes:
        info: its description.
        last: its last samples; None also for a number in another unit than the description's.
        age_s: age of the position by the daemon's own clock, seconds; None without one.
        rest_s: after how long the motion under way should have run its course, seconds; None without such an end.
        health: its last report; None before the first.
        condition: whether its place is known, and all that is to be said of it.
    """

    info: AxisInfo
    last: LastOfAxis
    age_s: float | None
    rest_s: float | None
    health: AxisHealth | None
    condition: Condition

    @property
    def seen(self) -> AxisSeen:
        """The same in values."""
        state, position, velocity = self.last.state, self.last.position, self.last.velocity
        is_live = self.condition.live
        return AxisSeen(
            position=position.value if position else None,
            quality=position.quality if position else None,
            age_s=self.age_s,
            place=self.condition.place,
            state=state.state if state and is_live else None,
            link=state.link if state and (is_live or state.link is LinkState.DOWN) else None,
            moving=state.moving if state and is_live else Moving.UNKNOWN,
            velocity=velocity.value if velocity and is_live else None,
            shown_velocity=quantity_text(velocity.value, self.info, Dimension.VELOCITY) if velocity and is_live else "",
            rest_s=self.rest_s if is_live else None,
            condition=self.condition.notes,
        )


def axis_now(
    info: AxisInfo, last: LastOfAxis, line: BusHealth | None, age_s: Callable[[int], float], silence: str = ""
) -> AxisNow:
    """Return how an axis is.

    Args:
        info: its description.
        last: its last samples.
        line: the last report about its line; None before the first.
        age_s: tells how old an instant of its daemon is, UTC in ns since 1970.
        silence: why nothing comes from its daemon; empty while it reports.
    """
    health = next((each for each in line.axes if each.axis == info.axis), None) if line else None
    last = LastOfAxis(last.state, last.fault, _described(last.position, info), _described(last.velocity, info))
    age = age_s(last.position.t) if last.position else None
    ends = last.state.command.expected_end if last.state and last.state.command else None
    return AxisNow(
        info,
        last,
        age,
        max(0.0, -age_s(ends)) if ends else None,
        health,
        assess(
            last.state,
            last.fault,
            health,
            age_s=age,
            state_age_s=age_s(last.state.t) if last.state else None,
            position_quality=last.position.quality if last.position else None,
            line_up=line.up if line else None,
            silence=silence,
        ),
    )


def _described(sample: SampleT | None, info: AxisInfo) -> SampleT | None:
    """Return a sample in the unit of a description; None for one of a daemon with another configuration."""
    return sample if sample and info.describes(sample) else None


async def modules_now(client: RigClient) -> dict[str, tuple[str, Condition]]:
    """Return the line and the condition of every I/O module that has a name."""
    return {
        module.module: (line.bus, assess_module(module, line_up=line.up))
        for line in await last_bus_health(client)
        for module in line.modules
    }


async def overview(client: RigClient) -> list[AxisNow]:
    """Return every axis, in the order of lines and addresses.

    Raises:
        SessionError: no daemon answers.
    """
    axes, states, positions = await client.axes(), await client.states(), await client.positions()
    velocities, faults, report = await client.velocities(), await client.faults(), await last_health(client)
    lines = {line.bus: line for line in await last_bus_health(client)}
    clock = DaemonClock()
    stamps = [sample.t for samples in (states, positions) for sample in samples.values()]
    for t in (*stamps, *([report.t] if report else [])):
        clock.note(t, 0.0)
    found = []
    for info in axes:
        name = info.axis
        last = LastOfAxis(states.get(name), faults.get(name), positions.get(name), velocities.get(name))
        found.append(axis_now(info, last, lines.get(info.bus), lambda t: clock.age_s(t, 0.0)))
    return found
