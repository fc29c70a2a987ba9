"""Highest velocity and acceleration: moves there and back within a distance, each a little faster, until it lags."""

import asyncio
import math
from collections.abc import Iterable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial

from typing_extensions import override

from ldcnd.bench.commissioning.record import ConfigProposal, Figure, PlotSeries, Result, StepState
from ldcnd.bench.commissioning.step import (
    Step,
    StepContext,
    closed_loop,
    key_released,
    moved_while_held,
    refuse_previewed,
)
from ldcnd.bench.kept_gains import open_loop
from ldcnd.client.axis import Axis
from ldcnd.contract.commands import Verb
from ldcnd.contract.errors import DriveFault, LdcndError

GROWTH = 1.25
"""From one step to the next."""
MOST_TIMES = 5.0
"""Without a limit in the configuration it goes to this many times the default velocity and acceleration."""
LAG_SHARE = 0.5
"""Share of the position error limit from which the drive does not follow any more."""
LATE_S = 0.5
LATE_SHARE = 0.2
"""Longest delay of the end of a motion behind its profile: seconds, and a share of its duration."""
SHARE = 0.8
"""Share of the fastest motion that it followed that is proposed."""
CRUISE = 1.5
"""A distance is long enough for a velocity from this many times its two ramps on."""
DIGITS = 3


@dataclass(frozen=True, slots=True)
class Tried:
    """One motion there and back.

    Attributes:
        velocity: in axis units a second.
        acceleration: in axis units a second squared.
        lag: largest following error, in axis units; None where the drive does not report it.
        late_s: how much longer than its profile it took at most, seconds.
        objection: why the drive does not follow; empty when it does.
    """

    velocity: float
    acceleration: float
    lag: float | None
    late_s: float
    objection: str

    @property
    def shown(self) -> str:
        """The outcome, for people."""
        lag = "" if self.lag is None else f", following error {self.lag:.3g}"
        return (self.objection or "followed") + lag


class HighestSpeed(Step):
    """Raises velocity, then acceleration, until the drive does not follow."""

    name = "speed"
    title = "Highest velocity and acceleration"
    about = (
        "The axis moves there and back while you hold the key, faster each time, until following error or duration"
        " say that the drive does not follow, or the limits of the configuration are reached."
    )
    needs = (Verb.POWER, Verb.MOVE_RELATIVE)
    depends = ("counts_per_unit", "gains")

    @override
    async def preview(self, site: StepContext) -> tuple[str, ...]:
        velocity, acceleration = _highest(site)
        el = f"; beyond {site.config.gains.el} counts the drive opens its loop and coasts" if site.config.gains else ""
        speeds = f"{site.config.velocity:g} to {site.length(velocity)}/s"
        return (
            f"{site.info.axis} moves forward by the distance that you choose, and back, at {speeds}",
            f"then with {site.config.acceleration:g} to {site.length(acceleration)}/s²",
            f"it ends at the first motion that the drive does not follow{el}",
            "the drive ends each motion there; letting go halts it and ends the step",
            "its loop is closed and stays closed; tune it before",
        )

    @override
    async def run(self, site: StepContext, axis: Axis) -> Result:
        person, config = site.person, site.config
        velocity, _ = _highest(site)
        enough = CRUISE * velocity * velocity / config.acceleration
        least = config.velocity * config.velocity / config.acceleration
        while (
            abs(distance := await person.number(f"how far may it move, signed, in {site.info.unit}", enough, site.info))
            < least
        ):
            person.tell(f"in less than {site.length(least)} it does not reach its velocity")
        refuse_previewed(await axis.preview(distance=distance, velocity=config.velocity))
        moves = f"{axis.name} moves by {site.length(distance)} and back, again and again"
        async with person.holding(moves) as held, closed_loop(site, axis):
            fast = await _tried(site, axis, distance, _velocities(site, distance), held)
            hard = [] if fast[-1].objection else await _tried(site, axis, distance, _accelerations(site), held)
        return _judged(site, distance, fast, hard)


async def _tried(
    site: StepContext, axis: Axis, distance: float, moves: Iterable[tuple[float, float]], held: asyncio.Event
) -> list[Tried]:
    """Move there and back with each velocity and acceleration; end behind the first that is not followed."""
    tried: list[Tried] = []
    for velocity, acceleration in moves:
        tried.append(await _try(site, axis, distance, velocity, acceleration, held))
        site.person.tell(
            f"{velocity:.4g} {site.info.unit}/s, {acceleration:.4g} {site.info.unit}/s²: {tried[-1].shown}"
        )
        if tried[-1].objection:
            break
    return tried


async def _try(
    site: StepContext, axis: Axis, distance: float, velocity: float, acceleration: float, held: asyncio.Event
) -> Tried:
    lags: list[float] = []
    late_s, objection = 0.0, ""
    for way in (distance, -distance):
        loop = asyncio.get_running_loop()
        began_s = loop.time()
        move = partial(axis.move_relative, way, velocity=velocity, acceleration=acceleration)
        try:
            moved = await moved_while_held(axis, move, held, partial(_watch, axis, lags))
        except DriveFault as fault:
            objection = fault.message
            await open_loop(axis)
            break
        if moved is None:
            raise key_released(axis)
        motion, ended = moved
        duration_s = motion.reply.duration_s or 0.0
        late_s = max(late_s, loop.time() - began_s - duration_s)
        if late_s > LATE_S + LATE_SHARE * duration_s:
            objection = f"it took {late_s:.2g} s longer than its profile"
        if ended.settled is False:
            objection = "it did not settle"
    lag = max(lags, default=None)
    most = LAG_SHARE * site.config.gains.el / site.counts_per_unit if site.config.gains else None
    if not objection and most is not None and lag is not None and lag > most:
        objection = f"its following error of {site.length(lag)} is above {site.length(most)}, half of what trips it"
    return Tried(velocity, acceleration, lag, late_s, objection)


async def _watch(axis: Axis, lags: list[float]) -> None:
    """Collect following errors until cancelled."""
    with suppress(LdcndError):  # the wait for the motion raises it
        async for sample in axis.positions():
            if sample.following_error is not None:
                lags.append(abs(sample.following_error))  # noqa: PERF401 - it does not end


def _highest(site: StepContext) -> tuple[float, float]:
    config, limits = site.config, site.info.limits
    return limits.velocity or MOST_TIMES * config.velocity, limits.acceleration or MOST_TIMES * config.acceleration


def _velocities(site: StepContext, distance: float) -> Iterator[tuple[float, float]]:
    """Yield growing velocities that the distance is long enough for; the configured one in any case."""
    acceleration = site.config.acceleration
    reached = math.sqrt(abs(distance) * acceleration / CRUISE)
    for velocity in _growing(site.config.velocity, min(_highest(site)[0], max(reached, site.config.velocity))):
        yield velocity, acceleration


def _accelerations(site: StepContext) -> Iterator[tuple[float, float]]:
    first, *_ = growing = list(_growing(site.config.acceleration, _highest(site)[1]))
    for acceleration in growing:
        if acceleration != first:  # which was tried with the velocities
            yield site.config.velocity, acceleration


def _growing(first: float, last: float) -> Iterator[float]:
    value = first
    while value < last:
        yield value
        value *= GROWTH
    yield last


def _judged(site: StepContext, distance: float, fast: list[Tried], hard: list[Tried]) -> Result:
    unit, config = site.info.unit, site.config
    slowest = fast[0]
    series = tuple(
        PlotSeries(title=title, x=x, y=f"following error, {unit}", points=points)
        for title, x, points in (
            ("Following error by velocity", f"{unit}/s", _points(fast, [each.velocity for each in fast])),
            ("Following error by acceleration", f"{unit}/s²", _points(hard, [each.acceleration for each in hard])),
        )
        if points
    )
    velocity = max((each.velocity for each in fast if not each.objection), default=0.0)
    acceleration = max((each.acceleration for each in hard if not each.objection), default=config.acceleration)
    figures = (
        Figure(what="distance", value=distance, unit=unit),
        Figure(what="highest velocity that it followed", value=velocity, unit=f"{unit}/s"),
        Figure(what="highest acceleration that it followed", value=acceleration, unit=f"{unit}/s²"),
    )
    if slowest.objection:
        text = f"it does not follow at {slowest.velocity:g} {unit}/s: {slowest.objection}; tune it, or begin slower"
        return Result(state=StepState.FAILED, text=text, figures=figures, series=series)
    proposals: list[ConfigProposal] = []
    said = []
    for key, tried, best in (("velocity", fast, velocity), ("acceleration", hard, acceleration)):
        if not tried or not tried[-1].objection:
            said.append(f"{key}: it followed up to {best:.4g}")
            continue
        share = float(f"{SHARE * best:.{DIGITS}g}")
        said.append(f"{key}: it followed up to {best:.4g}; then {tried[-1].objection}")
        proposals.append(ConfigProposal(table="limits", key=key, value=share))
        if getattr(config, key) > share:
            proposals.append(ConfigProposal(table="", key=key, value=share))
    return Result(
        state=StepState.DONE, text="; ".join(said), figures=figures, series=series, proposals=tuple(proposals)
    )


def _points(tried: list[Tried], at: list[float]) -> tuple[tuple[float, float], ...]:
    return tuple((x, each.lag) for x, each in zip(at, tried, strict=True) if each.lag is not None)
