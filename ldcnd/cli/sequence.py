"""`ldcnd sequence` and `ldcnd position`: named positions and sequences, carried out by this program as a client."""

import asyncio
import math
import sys
import time
from collections.abc import Iterable
from contextlib import ExitStack
from pathlib import Path

import click

from ldcnd.cli.connection import AXIS, Target, with_target
from ldcnd.cli.halting import halting
from ldcnd.cli.main import CommandGroup
from ldcnd.cli.output import FIRST_REPEAT_S, end_as_interrupted, keys, show_lines
from ldcnd.cli.quantities import in_counts, seconds
from ldcnd.cli.there import axis_of, unknown
from ldcnd.cli.typed import CONFIGURATION, NewFile, WholeNumber, force_option
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.client.sequences import SequenceRun
from ldcnd.config.edit import teach
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.errors import NotReferenced, WrongState
from ldcnd.contract.samples import Moving
from ldcnd.contract.sequences import NamedPosition, SequenceConfig, StepReport, going_to

PAUSE = " "


@click.group(cls=CommandGroup)
def sequence() -> None:
    """Carry out a sequence of the configuration, step by step."""


def _list_sequences(rig: RigConfig) -> None:
    units = {axis.name: axis.axis_units for bus in rig.bus for axis in bus.axis}
    positions = {each.name: each for each in rig.position}
    for each in rig.sequence:
        titles = [step.title(units, positions) for step in each.step]
        show_lines(each.name, *(f"  {at:3}  {title}" for at, title in enumerate(titles, 1)))


@sequence.command("run")
@click.argument("file", type=CONFIGURATION)
@click.argument("name", required=False)
@click.option("--list", "list_only", is_flag=True, help="Show the sequences of FILE and their steps, and end.")
@click.option("--from", "first", type=WholeNumber(1), default=1, show_default=True, help="Begin with this step.")
@click.option("--record", type=NewFile(), help="Write what happens to each step to this file, as JSON lines.")
@force_option
@click.option("--take", is_flag=True, help="Take control from its holder.")
@with_target
def run_sequence(
    target: Target, file: Path, name: str | None, first: int, record: Path | None, *, take: bool, list_only: bool
) -> None:
    """Carry out the sequence NAME of FILE, a rig's configuration.

    On a terminal the space bar has the next step wait, and go on. Ctrl-C, and a step that fails, halt what moves;
    outputs stay as they are.
    """
    rig = load_config(file)
    if list_only:
        _list_sequences(rig)
        return
    known = {each.name: each for each in rig.sequence}
    if name is None:
        raise click.UsageError("name the sequence, or see them with --list")
    if name not in known:
        raise unknown("sequence", name, known)
    _carry_out(target, rig, known[name], record, first, take=take)


def _carry_out(
    target: Target, rig: RigConfig, wanted: SequenceConfig, record: Path | None, first: int = 1, *, take: bool = False
) -> None:
    positions = {each.name: each for each in rig.position}
    with ExitStack() as open_files:
        written = open_files.enter_context(record.open("w", encoding="utf-8")) if record else None

        def report(step: StepReport) -> None:
            if written:
                written.write(f"{step.model_dump_json()}\n")
                written.flush()
            took = f" in {seconds(step.took_s)}" if step.took_s is not None else ""
            why = f": {step.reason}" if step.reason else ""
            target.show(step, f"{step.step:3}/{step.of}  {step.title}: {step.event}{took}{why}")

        async def work(client: RigClient) -> None:
            run = SequenceRun(Rig(client, await client.daemon()), wanted, positions, report, time.time_ns)
            await _check_means(client, rig, run.used)
            infos = [info for info in await client.axes() if info.axis in run.used]
            async with halting(client, *infos) as accepted, asyncio.TaskGroup() as group:
                accepted.set()  # from here on it may have begun something
                pausing = group.create_task(_pause_by_key(run.going), name="pause")
                try:
                    await run.run(first, force=take)
                finally:
                    pausing.cancel()

        end_as_interrupted()
        target.run(work)


async def _check_means(client: RigClient, rig: RigConfig, axes: Iterable[str]) -> None:
    """Refuse a file whose numbers mean other places to the daemon, before anything moves or is written.

    Raises:
        WrongState: it is of another rig, or an axis of the daemon has another unit or another scale.
    """
    if client.rig != rig.rig:
        raise WrongState(
            f"the file is of rig {rig.rig}, and the daemon runs rig {client.rig}",
            value=rig.rig,
            limit=client.rig,
            remedy="give the configuration of that rig, or its endpoint with --connect",
        )
    there = {info.axis: info for info in await client.axes()}
    named = set(axes)
    for config in (axis for bus in rig.bus for axis in bus.axis if axis.name in named):
        info = there.get(config.name)
        if info is None or config.meaning != info.meaning:
            raise WrongState(
                f"axis {config.name}: its unit, scale, direction or modulo in the file ({config.unit}) is not what the"
                f" daemon has ({info.unit if info else 'no such axis'}); nothing has moved",
                axis=config.name,
                value=config.unit,
                limit=info.unit if info else None,
                remedy="start the daemon with this file, or give the one that it was started with",
            )


async def _pause_by_key(going: asyncio.Event) -> None:
    """Pause at the key, and go on at the next one; one that is held down and repeats itself is pressed once.

    What comes together was held up on its way: it pauses, and nothing goes on for it.
    """
    if not sys.stdin.isatty():
        return
    loop, last_s = asyncio.get_running_loop(), -math.inf
    with keys() as keyboard:
        while True:
            burst = await keyboard.burst()
            if PAUSE not in burst:
                continue
            before_s, last_s = last_s, loop.time()
            if last_s - before_s >= FIRST_REPEAT_S and (going.is_set() or burst == PAUSE):
                going.clear() if going.is_set() else going.set()
                show_lines("goes on" if going.is_set() else "pauses before the next step; space goes on", err=True)


@click.group(cls=CommandGroup)
def position() -> None:
    """Teach named positions from where axes stand, and go to them."""


def _list_positions(rig: RigConfig) -> None:
    units = {axis.name: axis.unit for bus in rig.bus for axis in bus.axis}
    for each in rig.position:
        show_lines(f"{each.name:16} {', '.join(f'{axis} {at:g} {units[axis]}' for axis, at in each.axes.items())}")


@position.command("teach")
@click.argument("file", type=CONFIGURATION)
@click.argument("name")
@click.argument("axes", type=AXIS, nargs=-1, required=True, metavar="AXIS...")
@with_target
def teach_position(target: Target, file: Path, name: str, axes: tuple[str, ...]) -> None:
    """Write where each AXIS stands into FILE, a rig's configuration, as the position NAME; nothing moves.

    `go` moves them in the order in which they are named here. A position of that name is replaced.
    """

    async def work(client: RigClient) -> NamedPosition:
        await _check_means(client, load_config(file), axes)
        places = {}
        for axis in axes:
            info, state, place = await axis_of(client, axis), await client.state(axis), await client.position(axis)
            if state is None or place is None or not state.referenced:
                raise NotReferenced(f"axis {axis}: where it stands is not known", axis=axis, remedy="home it first")
            if state.moving is not Moving.NO:
                raise WrongState(f"axis {axis} moves: {state.moving.value}", axis=axis, remedy="wait until it stands")
            places[axis] = in_counts(place.value, info)
        return NamedPosition(name=name, axes=places)

    taught = target.run(work)
    teach(file, name, taught.axes)
    target.show(taught, f"{name}: {', '.join(f'{axis} {at:g}' for axis, at in taught.axes.items())}")


@position.command("go")
@click.argument("file", type=CONFIGURATION)
@click.argument("name", required=False)
@click.option("--list", "list_only", is_flag=True, help="Show the named positions of FILE, and end.")
@click.option("--take", is_flag=True, help="Take control from its holder.")
@with_target
def go(target: Target, file: Path, name: str | None, *, take: bool, list_only: bool) -> None:
    """Move the axes of the position NAME of FILE there, one after the other; Ctrl-C halts them."""
    rig = load_config(file)
    if list_only:
        _list_positions(rig)
        return
    known = {each.name: each for each in rig.position}
    if name is None:
        raise click.UsageError("name the position, or see them with --list")
    if name not in known:
        raise unknown("position", name, known)
    _carry_out(target, rig, going_to(known[name]), None, take=take)
