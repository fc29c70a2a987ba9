"""What is known of a rig now: the reports of its daemon, and of every axis description, samples and condition."""

from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass

from ldcnd.client.daemon_clock import DaemonClock
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.codec import decode_received
from ldcnd.contract.condition import Condition, Place, assess, assess_module
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.health import AxisHealth, BusHealth, DaemonHealth
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.samples import AxisState, FaultSample, LinkState, Moving, PositionSample, Quality, StateSample
from ldcnd.net.session import Publication, SampleKind


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
    """Whether the drive answers."""
    moving: Moving
    """Whether it moves; unknown is an answer of its own and never means no."""
    condition: tuple[str, ...]
    """Everything that is to be said of it, in a few words each, the worst first."""


def seen_of(
    state: StateSample | None, position: PositionSample | None, age_s: float | None, condition: Condition
) -> AxisSeen:
    """Return how an axis is by its last samples, the age of its position in seconds, and its condition."""
    return AxisSeen(
        position=position.value if position else None,
        quality=position.quality if position else None,
        age_s=age_s,
        place=condition.place,
        state=state.state if state else None,
        link=state.link if state else None,
        moving=state.moving if state and condition.live else Moving.UNKNOWN,
        condition=condition.notes,
    )


@dataclass(frozen=True, slots=True)
class AxisNow:
    """One axis as its daemon has shown it last.

    Attributes:
        info: its description.
        state: None before the first.
        position: None before the first.
        age_s: age of the position by the daemon's own clock, seconds; None without one.
        health: its last report; None before the first.
        condition: whether its place is known, and all that is to be said of it.
    """

    info: AxisInfo
    state: StateSample | None
    position: PositionSample | None
    age_s: float | None
    health: AxisHealth | None
    condition: Condition


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
    faults, report = await client.faults(), await last_health(client)
    lines = {line.bus: line for line in await last_bus_health(client)}
    clock = DaemonClock()
    stamps = [sample.t for samples in (states, positions) for sample in samples.values()]
    for t in (*stamps, *([report.t] if report else [])):
        clock.note(t, 0.0)
    found = []
    for info in axes:
        line, state, position = lines.get(info.bus), states.get(info.axis), positions.get(info.axis)
        health = next((each for each in line.axes if each.axis == info.axis), None) if line else None
        age_s = clock.age_s(position.t, 0.0) if position else None
        fault: FaultSample | None = faults.get(info.axis)
        condition = assess(state, fault, health, age_s=age_s, line_up=line.up if line else None)
        found.append(AxisNow(info, state, position, age_s, health, condition))
    return found
