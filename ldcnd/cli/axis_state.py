"""`ldcnd axis`: what axes are, and where they are."""

import asyncio
from datetime import UTC, datetime

import click

from ldcnd.cli.connection import AXIS, Target, with_target
from ldcnd.cli.quantities import decimals, sample_text
from ldcnd.cli.typed import Whole, axis_of
from ldcnd.client.overview import AxisNow, overview
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.condition import Place, assess
from ldcnd.contract.errors import LdcndError
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
    TelemetryItem,
)

SILENT_S = 3.0
"""Time without a sample after which `axis watch` says why, seconds."""


class AxisRow(AxisInfo):
    """An axis as `axis list --json` has it: its description, and how it is now."""

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
    referenced: bool
    """The position is valid."""
    link: LinkState | None
    """Whether the drive answers."""
    moving: Moving
    """Whether it moves; unknown is an answer of its own and never means no."""
    condition: tuple[str, ...]
    """Everything that is to be said of it, in a few words each, the worst first."""


@click.command("list")
@with_target
def list_axes(target: Target) -> None:
    """Show every axis: where it is, its state, whether it moves, and whether its drive answers.

    A position in brackets does not say where the axis is; the words behind it say why.
    """
    axes = target.run(overview)
    for now, line in zip(axes, table(axes), strict=True):
        target.show(row(now), line)


def table(axes: list[AxisNow]) -> list[str]:
    """Return a line for each axis; a number that does not say where the axis is stands in brackets."""
    cells = [
        (
            now.info.axis,
            now.info.model,
            f"{now.info.bus}/{now.info.address}",
            now.condition.position(_digits(now), now.info.unit, now.age_s),
            now.condition.state,
            f"moving {row(now).moving}",
            f"link {now.state.link if now.state else 'unknown'}",
            ", ".join(now.condition.notes),
        )
        for now in axes
    ]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return ["  ".join(map(str.ljust, each, widths)).rstrip() for each in cells]


def _digits(now: AxisNow) -> str | None:
    return f"{now.position.value:.{decimals(now.info)}f}" if now.position else None


def row(now: AxisNow) -> AxisRow:
    """Return an axis as `--json` has it."""
    state, position = now.state, now.position
    return AxisRow(
        **now.info.model_dump(),
        position=position.value if position else None,
        quality=position.quality if position else None,
        age_s=now.age_s,
        place=now.condition.place,
        state=state.state if state else None,
        referenced=state is not None and state.referenced and now.condition.live,
        link=state.link if state else None,
        moving=state.moving if state and now.condition.live else Moving.UNKNOWN,
        condition=now.condition.notes,
    )


@click.command()
@click.argument("axis", type=AXIS)
@with_target
def faults(target: Target, axis: str) -> None:
    """Show the faults that AXIS has had, oldest first; `ldcnd fault CODE` explains them."""
    for each in target.run(lambda client: axis_of(client, axis)).past_faults:
        at = datetime.fromtimestamp(each.since / 1e9, UTC).isoformat(timespec="milliseconds")
        target.show(each, f"{at} {each.code:16} {each.source:7} {each.text}")


@click.command()
@click.argument("axis", type=AXIS, default="*")
@click.option("--item", type=click.Choice([item.value for item in TelemetryItem]), help="Only this item.")
@click.option("--count", type=Whole(min=1), help="End after this many samples.")
@with_target
def watch(target: Target, axis: str, item: str | None, count: int | None) -> None:
    """Show the telemetry of AXIS, an axis or an I/O module (or of all), as it comes."""

    async def work(client: RigClient) -> None:
        if axis != "*" and axis not in {module.name for bus in await client.buses() for module in bus.modules}:
            await axis_of(client, axis)
        seen, watched = 0, Watched()
        async with client.samples(axis, item or "*") as samples:
            _say_conditions(watched, await overview(client), axis)
            while seen != count:
                try:
                    async with asyncio.timeout(SILENT_S):
                        name, sample = await anext(samples)
                except TimeoutError:
                    await _say_silence(client, axis)
                    continue
                target.show(sample, f"{name:8} {watched.text(name, sample)}")
                seen += 1

    target.run(work)


class Watched:
    """The last state and faults of the axes that are watched: they say what their positions are worth."""

    def __init__(self) -> None:
        self._states: dict[str, StateSample] = {}
        self._faults: dict[str, FaultSample] = {}
        self._now: dict[str, AxisNow] = {}

    def begin(self, now: AxisNow) -> None:
        """Take what is known of an axis before its first sample."""
        self._now[now.info.axis] = now
        if now.state:
            self._states[now.info.axis] = now.state

    def text(self, name: str, sample: Sample) -> str:
        """Return a sample in words, with the condition of its axis where that matters."""
        if isinstance(sample, FaultSample):
            self._faults[name] = sample
        if isinstance(sample, StateSample):
            self._states[name] = sample
        if name in self._now and isinstance(sample, PositionSample | StateSample):
            condition = assess(self._states.get(name), self._faults.get(name))
            if isinstance(sample, PositionSample):
                return f"position {condition.position(f'{sample.value:.4f}', sample.unit)}"
            return f"state    {condition.summary}"
        return sample_text(sample)


def _say_conditions(watched: Watched, axes: list[AxisNow], wanted: str) -> None:
    """Say at once what is wrong: an axis that does not answer brings no sample that would."""
    for now in axes:
        if wanted in ("*", now.info.axis):
            watched.begin(now)
            if now.condition.wrong:
                click.echo(f"{now.info.axis:8} {_all_of(now)}", err=True)


async def _say_silence(client: RigClient, wanted: str) -> None:
    try:
        found = await overview(client)
    except LdcndError as error:
        click.echo(f"no sample for {SILENT_S:g} s: {error.message}", err=True)
        return
    for now in found:
        if wanted in ("*", now.info.axis) and not now.condition.live:
            click.echo(f"{now.info.axis:8} no sample for {SILENT_S:g} s: {_all_of(now)}", err=True)


def _all_of(now: AxisNow) -> str:
    where = now.condition.position(_digits(now), now.info.unit, now.age_s)
    return f"{where}, {now.condition.summary}"
