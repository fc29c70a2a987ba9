"""Commands that show a rig and change nothing: axes, drives, obstacles, events, faults; all rigs at once."""

import asyncio
import sys
from collections.abc import AsyncIterator, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from difflib import get_close_matches

import click
from click.shell_completion import CompletionItem

from ldcnd.cli.connection import AXIS, Target, with_target
from ldcnd.cli.names import typed
from ldcnd.cli.quantities import decimals, sample_text
from ldcnd.cli.there import axis_of, check_there
from ldcnd.cli.typed import Finite, WholeNumber
from ldcnd.client.fleet import AxisReport, RigReport, survey
from ldcnd.client.overview import AxisNow, AxisSeen, last_health, modules_now, overview
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.codec import remedy_of
from ldcnd.contract.commands import Verb
from ldcnd.contract.condition import SILENT_S, Condition, Place, assess, explained_as
from ldcnd.contract.errors import LdcndError, NotSupported, SessionError
from ldcnd.contract.fault_pages import codes, page_text
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.parameters import (
    ReadMonitors,
)
from ldcnd.contract.questions import Why, WhyReply
from ldcnd.contract.samples import (
    SAMPLE_ITEMS,
    FaultSample,
    LinkState,
    MonitorName,
    MonitorSample,
    Moving,
    PositionSample,
    Quality,
    Sample,
    StateSample,
    TelemetryItem,
    VelocitySample,
)
from ldcnd.contract.troubles import daemon_troubles
from ldcnd.contract.units import Dimension, shown_quantity
from ldcnd.net.session import Session


class AxisRow(AxisSeen, AxisInfo):
    """An axis as `list --json` has it: its description, and how it is now."""

    referenced: bool
    """The position is valid."""


@click.command("list")
@with_target
def list_axes(target: Target) -> None:
    """Show every axis: where it is, its state, whether it moves, and whether its drive answers; and I/O modules.

    A position in brackets does not say where the axis is; the words behind it say why.
    """

    async def work(client: RigClient) -> tuple[list[AxisNow], dict[str, tuple[str, Condition]], tuple[str, ...]]:
        return await overview(client), await modules_now(client), daemon_troubles(await last_health(client))

    axes, modules, troubles = target.run(work)
    for now, line in zip(axes, axes_table(axes), strict=True):
        target.show(row(now), line)
    for name, (bus, condition) in modules.items():
        if not target.as_json:  # there a row is an axis
            click.echo(f"{name}  I/O module  {bus}  {condition.summary}")
    for trouble in troubles:
        click.echo(f"! {trouble}", err=True)


def axes_table(axes: list[AxisNow]) -> list[str]:
    """Return a line for each axis; a number that does not say where the axis is stands in brackets."""
    cells = [
        (
            now.info.axis,
            now.info.model,
            f"{now.info.bus}/{now.info.address}",
            now.condition.position(_digits(now), now.info.unit, now.age_s),
            now.condition.state,
            f"moving {_motion(now.seen)}",
            _link(now.last.state),
            ", ".join(now.condition.notes),
        )
        for now in axes
    ]
    return _aligned(cells)


def _aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Return rows as lines with columns as wide as what is in them; a column without anything is left out."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True) if width).rstrip() for row in rows
    ]


def _link(state: StateSample | None) -> str:
    """Return the link of an axis where it is not up: on 80 columns there is room for what is out of the ordinary."""
    if state is None:
        return "link unknown"
    return "" if state.link is LinkState.UP else f"link {state.link}"


def _motion(seen: AxisSeen) -> str:
    """Return whether an axis moves, and how fast and for how long if it does.

    Drives count velocity in whole counts a servo tick: a slow motion reads 0 at times, which says nothing.
    """
    if seen.moving is not Moving.YES:
        return seen.moving.value
    speed = f"about {seen.shown_velocity}" if seen.velocity else ""
    rest = "" if seen.rest_s is None else f"for another {seen.rest_s:.1f} s"
    return " ".join(filter(None, (seen.moving.value, speed, rest)))


def _digits(now: AxisNow) -> str | None:
    position = now.last.position
    return f"{position.value:.{decimals(now.info)}f}" if position else None


def row(now: AxisNow) -> AxisRow:
    """Return an axis as `--json` has it."""
    state = now.last.state
    return AxisRow(
        **now.info.model_dump(),
        **dict(now.seen),
        referenced=state is not None and state.referenced and now.condition.live,
    )


@click.command()
@click.argument("axis", type=AXIS, default="*")
@click.option("--item", type=click.Choice([item.value for item in TelemetryItem]), help="Only this item.")
@click.option("--count", type=WholeNumber(min=1), help="End after this many samples.")
@with_target
def watch(target: Target, axis: str, item: str | None, count: int | None) -> None:
    """Show the telemetry of AXIS, an axis or an I/O module (or of all), as it comes."""

    async def work(client: RigClient) -> None:
        if axis != "*":
            await check_there(client, axis)
        seen, watched = 0, Watched(item)
        async with client.samples(axis) as samples:  # states and faults also where they are not shown
            _say_conditions(watched, await overview(client), axis)
            await _say_modules(client, axis)
            while seen != count:
                try:
                    async with asyncio.timeout(SILENT_S):
                        name, sample, text = await watched.next_of(samples)
                except TimeoutError:
                    await _say_silence(client, axis)
                    await _say_modules(client, axis)
                    continue
                target.show(sample, f"{name:8} {text}")
                seen += 1

    target.follow(work)


class Watched:
    """The last state and faults of the axes that are watched: they say what their positions are worth.

    Args:
        item: the only one that is shown; None for all of them.
    """

    def __init__(self, item: str | None = None) -> None:
        self._item = item
        self._states: dict[str, StateSample] = {}
        self._faults: dict[str, FaultSample] = {}
        self._now: dict[str, AxisNow] = {}

    def begin(self, now: AxisNow) -> None:
        """Take what is known of an axis before its first sample."""
        self._now[now.info.axis] = now
        if now.last.state:
            self._states[now.info.axis] = now.last.state
        if now.last.fault:
            self._faults[now.info.axis] = now.last.fault

    async def next_of(self, samples: AsyncIterator[tuple[str, Sample]]) -> tuple[str, Sample, str]:
        """Return the next sample that is shown, with its axis in front and in words; those before it are taken."""
        while True:
            name, sample = await anext(samples)
            text = self.text(name, sample)
            if self._item in (None, SAMPLE_ITEMS.get(type(sample))):
                return name, sample, text

    def text(self, name: str, sample: Sample) -> str:
        """Take a sample; return it in words, with the condition of its axis where that matters."""
        if isinstance(sample, FaultSample):
            self._faults[name] = sample
        if isinstance(sample, StateSample):
            self._states[name] = sample
        state, faults = self._states.get(name), self._faults.get(name)
        if isinstance(sample, StateSample):
            return f"state    {assess(state, faults).in_full}"
        if isinstance(sample, PositionSample):
            condition = assess(state, faults, position_quality=sample.quality)
            is_doubted = condition.place is Place.KNOWN and sample.quality is not Quality.GOOD
            where = condition.position(f"{sample.value:.4f}", sample.unit)
            return f"position {where}{f'  ({sample.quality})' if is_doubted else ''}"
        info = self._now[name].info if name in self._now else None
        if info and isinstance(sample, VelocitySample) and info.describes(sample):
            value, unit = shown_quantity(sample.value, info, Dimension.VELOCITY)
            sample = sample.model_copy(update={"value": value, "unit": unit})
        return sample_text(sample)


def _say_conditions(watched: Watched, axes: list[AxisNow], wanted: str) -> None:
    """Say at once what is wrong: an axis that does not answer brings no sample that would."""
    for now in axes:
        if wanted in ("*", now.info.axis):
            watched.begin(now)
            if now.condition.wrong:
                click.echo(f"{now.info.axis:8} {_all_of(now)}", err=True)


async def _say_modules(client: RigClient, wanted: str) -> None:
    """Say what is wrong with I/O modules."""
    with suppress(LdcndError):  # that nothing answers is said of the axes
        for name, (_, condition) in (await modules_now(client)).items():
            if wanted in ("*", name):
                for trouble in condition.wrong:
                    click.echo(f"{name:8} {trouble.text}", err=True)


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
    return f"{where}, {now.condition.in_full}"


@click.command()
@click.argument("axis", type=AXIS)
@click.argument("names", nargs=-1, metavar="[NAME]...", type=click.Choice([name.value for name in MonitorName]))
@click.option("--read", is_flag=True, help="Read them now, published or not.")
@with_target
def monitors(target: Target, axis: str, names: tuple[str, ...], *, read: bool) -> None:
    """Show the last values of the monitors of AXIS; all of them without a NAME."""
    chosen = tuple(MonitorName(name) for name in names)
    if read:
        reply = target.run(lambda client: client.command(axis, ReadMonitors(monitors=chosen)))
        for each in reply.readings:
            on = "" if each.active is None else f"  on: {', '.join(each.active) or 'none'}"
            high = f"  high: {', '.join(each.high)}" if each.high else ""
            target.show(each, f"{each.monitor:24} {each.value:>8} {each.unit:14}{each.title}{high}{on}")
        return

    async def work(client: RigClient) -> dict[MonitorName, MonitorSample]:
        info = await axis_of(client, axis)
        if not info.monitors:
            raise NotSupported(f"axis {axis} has no monitors: its drive is a {info.model}", axis=axis)
        return await client.monitors(axis)

    for name, sample in target.run(work).items():
        if not chosen or name in chosen:
            high = f"  high: {', '.join(sample.high)}" if sample.high else ""
            line = f"{name:22} {sample.value:8d} {sample.unit:14} {sample.title}{high}  ({sample.quality})"
            target.show(sample, line)


OTHER_MOTIONS = {Verb.MOVE_RELATIVE: "by a distance", Verb.MOVE_VELOCITY: "at a velocity"}


@click.command()
@click.argument("axis", type=AXIS)
@click.argument("command", type=click.Choice([verb.value for verb in Verb]), required=False, metavar="[COMMAND]")
@with_target
def why(target: Target, axis: str, command: str | None) -> None:
    """Tell why AXIS cannot move now, and what would clear that; exits with 1 when something is in the way.

    With a COMMAND, such as move_velocity, that is asked of this command alone.
    """
    asked = None if command is None else Verb(command)

    async def work(client: RigClient) -> tuple[AxisInfo, WhyReply]:
        reply = await client.ask(Why(command=asked, each_command=asked is None), axis)
        return await axis_of(client, axis), reply

    info, reply = target.run(work)
    taken = {verb for each in reply.commands if not each.causes for verb in each.verbs}
    others = " or ".join(words for verb, words in OTHER_MOTIONS.items() if verb in taken)
    without = f"cannot move to a position now, only {others}" if others else "cannot move now"
    ready = "ready to move"
    if asked:
        ready, without = f"ready for {asked}", f"{asked} would be refused now"
    lines = [f"{axis}: {ready if reply.can_move else without}"]
    for cause in reply.causes:
        known = remedy_of(cause)
        remedy = known and known.phrased(lambda step: typed(step, axis))
        lines.append(f"  {cause.text}{f': {remedy}' if remedy else ''}")
        if cause.page:
            lines.append(f"    more: ldcnd fault {cause.page.rpartition('/')[2]}")
    lines += [f"  {override}" for override in reply.overrides]
    if reply.first_fault:
        lines.append(f"  first fault since the last reset: {reply.first_fault}")
    for fault in info.past_faults:
        at = datetime.fromtimestamp(fault.since / 1e9, UTC).isoformat(timespec="milliseconds")
        lines.append(f"  past fault: {at} {fault.code}: {fault.text}")
    target.show(reply, *lines)
    if not reply.can_move:
        sys.exit(1)


@click.command()
@click.option("--watch", type=Finite(min=0.5, max=3600), help="Period of updates, seconds.")
@with_target
def fleet(target: Target, watch: float | None) -> None:
    """Show every rig across routers: its daemon, its lines and axes, and what is wrong with them.

    With --json, one line for each rig.
    """

    async def work(session: Session) -> None:
        while True:
            fleet = await survey(session, target.rig)
            if not fleet and watch is None:
                raise SessionError(
                    "no rig answers", remedy="start one with `ldcnd run`, or name a router with --connect"
                )
            for rig in fleet:
                target.show(rig, *rig_table(rig))
            if watch is None:
                return
            if not fleet:
                click.echo("no rig answers", err=True)
            await asyncio.sleep(watch)

    target.run_session(work)


def rig_table(rig: RigReport) -> list[str]:
    """Return a rig as lines of text: itself, what is wrong, its axes."""
    version = f"ldcnd {rig.daemon.version}" if rig.daemon else "version unknown"
    lines = [f"{rig.rig}  {version}  run {rig.instance}  {'needs attention' if rig.problems else 'well'}"]
    lines += [f"  ! {problem}" for problem in rig.problems]
    lines += [f"  {line}" for line in _aligned([_axis(axis) for axis in rig.axes])]
    return lines


def _axis(axis: AxisReport) -> tuple[str, ...]:
    info, state, health = axis.info, axis.state, axis.health
    where = f"{info.bus}/{info.address}"
    what = axis.condition.in_full
    link = state.link.value if state else "?"
    rate = f"{health.rate_hz:5.1f} Hz" if health else "    ? Hz"
    return info.axis, info.model, where, link, rate, what


class Code(click.types.StringParamType):
    """A code that has a page; the shell completes it."""

    def shell_complete(self, ctx: click.Context, param: click.Parameter, incomplete: str) -> list[CompletionItem]:  # noqa: ARG002
        """Return the codes that begin so."""
        return [CompletionItem(code) for code in sorted(codes()) if code.startswith(incomplete)]


@click.command()
@click.argument("words", nargs=-1, metavar="[CODE]", type=Code())
def fault(words: tuple[str, ...]) -> None:
    """Explain CODE, a fault or an error: what to check, how to clear it; without CODE list all of them.

    CODE may also be what `list` says of an axis, such as: not homed.
    """
    if not words:
        print("\n".join(sorted(codes())))
        return
    code = " ".join(words)
    page = page_text(code) or page_text(explained_as(code))
    if page is None:
        near = next(iter(get_close_matches(code, codes(), 1)), None)
        meant = f"did you mean {near!r}? " if near else ""
        raise click.BadParameter(
            f"there is no page for {code!r}; {meant}`ldcnd fault` lists all of them", param_hint="CODE"
        )
    print(page, end="")
