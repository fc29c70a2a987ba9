"""How commands reach axes: checked names, one lease, the reply in units, and a wait whose end halts what was begun."""

import asyncio
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, nullcontext, suppress
from enum import Enum
from functools import wraps
from types import MappingProxyType, NoneType
from typing import Any, Literal, TypeVar, get_args, get_origin

import click
from typing_extensions import override

from ldcnd.cli.connection import AXIS, Target, of_options, with_target
from ldcnd.cli.halting import NAME, halting
from ldcnd.cli.names import whose
from ldcnd.cli.nearest import Typed, naming_nearest, nearest_lines
from ldcnd.cli.output import FAILED, UNREACHABLE, end_as_interrupted, show_error, show_lines, show_passing
from ldcnd.cli.quantities import number, outcome, sample_text, values_of
from ldcnd.cli.there import axis_of
from ldcnd.cli.typed import Finite, Quantity, WholeNumber, in_units
from ldcnd.client.motion import failure
from ldcnd.client.rig_client import RigClient, Samples
from ldcnd.contract.commands import About, AxisCommand, Command, CommandReply, Effect, Verb
from ldcnd.contract.condition import assess
from ldcnd.contract.errors import LdcndError, SessionError, UnknownAxis, WrongState
from ldcnd.contract.events import CommandOutcome, CommandStatus
from ldcnd.contract.frozen import Frozen, attribute_docstrings, own_fields_first
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.questions import PreviewReply
from ldcnd.contract.samples import PositionSample, Sample, StateSample, TelemetryItem
from ldcnd.contract.units import DIMENSIONS

NOTHING: Mapping[str, object] = MappingProxyType({})

Sent = AxisCommand[CommandReply]
ReplyT = TypeVar("ReplyT", bound=Frozen)
Outcomes = dict[str, CommandReply | LdcndError]
"""What came of a command on each axis, by its name."""


def commanding(work: Callable[..., None]) -> Callable[..., None]:
    """Give a command its options for finding the daemon, and one for the lease under which it is sent."""

    @click.option("--lease", envvar="LDCND_LEASE", help="Send it under this lease, as `ldcnd lease hold` prints it.")
    @with_target
    @wraps(work)
    def command(target: Target, /, *, lease: str | None, **options: Any) -> None:  # noqa: ANN401 - click's own values
        work(Sender(target, lease or None), **options)

    return command


class Sender:
    """Sends the commands of one call of the command line.

    Args:
        target: where the daemon is.
        lease: under which lease; None without one.
    """

    def __init__(self, target: Target, lease: str | None) -> None:
        self.target = target
        self.lease = lease

    def send(
        self,
        axis: str,
        command: Sent,
        given: Mapping[str, object] = NOTHING,
        *,
        wait: bool = False,
        leave_running: bool = False,
    ) -> None:
        """Send one command and show its reply; with `wait` return when it has ended.

        Its numbers are taken from what is `given`, in the units of the axis.

        Ctrl-C, SIGTERM and the end of the terminal halt an axis that is waited for, unless it is to be left running.
        Without a wait Ctrl-C says how to halt what may go on.
        """
        if command.takes_energy_out:
            self.send_to_all((axis,), command, "done" if wait else "accepted", wait=wait)
            return
        if wait:
            end_as_interrupted()

        async def work(client: RigClient) -> tuple[StateSample, CommandOutcome, str, Sample | None] | None:
            info = await axis_of(client, axis)
            converted = in_units(command, given, info)
            context: AbstractAsyncContextManager[asyncio.Event] = nullcontext(asyncio.Event())
            if command.effect is Effect.MOTION:
                context = halting(client, info, leave_running=leave_running or not wait)
            async with context as accepted:
                found = assess(await client.state(axis)) if command.effect is Effect.MOTION else None
                with naming_nearest((converted, given, info)):
                    reply = await self.command(client, axis, converted)
                accepted.set()
                words = command.verb.replace("_", " ")
                waits = f", waits until {reply.waits_for} has ended" if reply.waits_for else ""
                values = values_of(reply, info, found)
                self.target.show(reply, f"{whose(client.rig)}{axis}: {words} accepted{values}{waits}")
                if not wait:
                    return None
                state, ended = await _follow(client, info, reply)
                if reply.waits_for and ended.status is not CommandStatus.DONE:
                    raise failure(ended)
                latch = await client.last(axis, TelemetryItem.LATCH) if command.verb == Verb.PROBE else None
                return state, ended, f"{whose(client.rig)}{outcome(info, ended, state)}", latch

        waited_for = self.target.run(work)
        if waited_for is None:
            return
        state, ended, said, latch = waited_for
        self.show_end(state, ended, said)
        if latch:
            self.target.show(latch, f"{axis}: {sample_text(latch)}")
        if ended.status is not CommandStatus.DONE:
            sys.exit(FAILED)

    def show_end(self, state: StateSample, ended: CommandOutcome, said: str) -> None:
        """Show the state behind a command that was waited for, in JSON with how that has ended: it may be another's."""
        self.target.show(state, said, status=ended.status, reason=ended.reason)

    def send_to_all(self, axes: Sequence[str], command: Sent, said: str = "done", *, wait: bool = False) -> None:
        """Send one command to several axes, all that take it when none is named; tell how it went with each.

        With `wait` return when it has ended everywhere.

        What takes energy out goes to every rig that can be reached unless one is named, and to each axis that is named
        by itself: it asks no question first, and a wrong name keeps it from no other axis.
        """
        rig = ""

        async def work(client: RigClient) -> Outcomes:
            nonlocal rig
            rig = client.rig
            asked = not (axes and command.takes_energy_out)
            wanted = await _there(client, axes, Verb(command.verb)) if asked else axes
            async with asyncio.TaskGroup() as group:
                tasks = {
                    axis: group.create_task(self._outcome(client, axis, command, wait=wait), name=axis)
                    for axis in wanted
                }
            return {axis: task.result() for axis, task in tasks.items()}

        if not command.takes_energy_out:
            done = self.target.run(work)
            reached = {whose(rig): list(done.values())}
        else:
            reached = _of_each_rig(self.target.run_on_each(work))
        for who, outcomes in reached.items():
            for each in outcomes:
                if isinstance(each, LdcndError):
                    show_error(each, who)
                else:
                    self.target.show(each, f"{who}{each.axis}: {each.verb.replace('_', ' ')} {said}")
        failures = [each for outcomes in reached.values() for each in outcomes if isinstance(each, LdcndError)]
        if failures:
            sys.exit(UNREACHABLE if all(isinstance(each, SessionError) for each in failures) else FAILED)

    async def command(self, client: RigClient, axis: str, command: Sent) -> CommandReply:
        """Send one command, under the lease if there is one."""
        named = command.model_copy(update={"lease": self.lease, "client": None if self.lease else NAME})
        return await client.command(axis, named)

    async def _outcome(self, client: RigClient, axis: str, command: Sent, *, wait: bool) -> CommandReply | LdcndError:
        heard = "sent, and not answered yet"
        try:
            reply = await self.command(client, axis, command)
            heard = "accepted, and it is not known to stand yet"
            if wait:
                await client.wait_for_end(axis, reply.command_id)
                try:
                    await client.wait_for_rest(axis)
                except WrongState as error:  # its load may turn one whose loop is open, or it coasts
                    show_error(error)
                    show_lines(f"{axis}: this waits on until it stands; Ctrl-C ends the wait", err=True)
                    await client.wait_for_rest(axis, None)
        except asyncio.CancelledError:
            with suppress(OSError):
                show_lines(f"{whose(client.rig)}{axis}: {command.verb.replace('_', ' ')} {heard}", err=True)
            raise
        except LdcndError as error:
            return error
        return reply


async def _there(client: RigClient, axes: Sequence[str], verb: Verb) -> Sequence[str]:
    """Return axes by their names, all that take a verb where none is named.

    Raises:
        UnknownAxis: the rig has none of a name.
        SessionError: the rig does not say which axes it has.
    """
    infos = await client.axes()
    if not infos and (await client.daemon()).axes:  # silence is no rig without axes, for which nothing is to be done
        raise SessionError(f"rig {client.rig} does not say what its axes are; nothing was sent", remedy="try again")
    for axis in axes:
        await axis_of(client, axis)
    return axes or [info.axis for info in infos if verb in info.capabilities]


def _of_each_rig(on_each: Mapping[str, Outcomes | LdcndError]) -> dict[str, list[CommandReply | LdcndError]]:
    """Return what came of it, by the words that name each rig: of several most have no axis of a name."""
    outcomes: dict[str, Mapping[str, CommandReply | LdcndError]] = {
        rig: {"": made} if isinstance(made, LdcndError) else made for rig, made in on_each.items()
    }
    there = {axis for made in outcomes.values() for axis, each in made.items() if not isinstance(each, UnknownAxis)}
    return {
        whose(rig, len(on_each)): [
            each for axis, each in made.items() if axis not in there or not isinstance(each, UnknownAxis)
        ]
        for rig, made in outcomes.items()
    }


async def _follow(client: RigClient, info: AxisInfo, reply: CommandReply) -> tuple[StateSample, CommandOutcome]:
    """Wait as `RigClient.end_of`; on a terminal show where the axis is meanwhile."""
    async with client.samples(info.axis, TelemetryItem.POSITION) as positions, asyncio.TaskGroup() as group:
        showing = group.create_task(_show(info, positions), name="progress")
        try:
            return await client.end_of(reply)
        finally:
            showing.cancel()
            with suppress(OSError):
                show_passing("")


async def _show(info: AxisInfo, positions: Samples) -> None:
    if sys.stderr.isatty():
        async for _, sample in positions:
            if isinstance(sample, PositionSample):
                show_passing(f"{info.axis}: {number(sample.value, info)}")


WAITING = {
    "--wait": "Return when it has ended; Ctrl-C halts the axis.",
    "--leave-running": "With --wait: Ctrl-C ends the wait only, the axis moves on.",
}
"""Options of a command that moves an axis."""
Shown = Iterator[tuple[Frozen, Sequence[str]]]


class Derived(click.Command):
    """A command that sends one class: its arguments, its options and its help are the fields and words of the class."""


def derived(name: str, command: type[Sent], *arguments: str, moves: bool = False, rests: bool = False) -> Derived:
    """Return a command that sends one class to an axis and tells that the drive has accepted it.

    Args:
        name: what it is called.
        command: what it sends.
        arguments: the fields that are given by their place; the others are options.
        moves: it moves the axis, so it can be waited for.
        rests: it brings the axis to rest, which can be waited for.
    """

    @commanding
    def callback(
        sender: Sender,
        /,
        axis: str,
        *,
        wait: bool = False,
        leave_running: bool = False,
        **given: Any,  # noqa: ANN401
    ) -> None:
        sender.send(axis, of_options(command, **given), given, wait=wait, leave_running=leave_running)

    waits = WAITING if moves else {"--wait": "Return when the axis stands."} if rests else {}
    waiting = [click.Option([name], is_flag=True, help=text) for name, text in waits.items()]
    return _derived(name, command, callback, arguments, [click.Argument(["axis"], type=AXIS)], waiting)


def derived_for_all(name: str, command: type[Sent], *arguments: str) -> Derived:
    """Return a command that sends one class to the axes that are named behind its arguments, or to all that take it."""

    @commanding
    def callback(sender: Sender, /, axes: tuple[str, ...], **given: Any) -> None:  # noqa: ANN401
        sender.send_to_all(axes, of_options(command, **given))

    axes = click.Argument(["axes"], type=AXIS, nargs=-1, metavar="[AXIS]...")
    made = _derived(name, command, callback, arguments, [], [axes])
    made.help = f"{made.help}\n\nOf each AXIS that is named; without one, of all axes that have it."
    return made


def derived_question(
    name: str,
    command: type[Command[ReplyT]],
    *arguments: str,
    shows: Callable[[ReplyT, AxisInfo | None], Shown],
    confirm: str = "",
) -> Derived:
    """Return a command that sends one class to an axis or a rig and shows the reply.

    Args:
        name: what it is called.
        command: what it sends.
        arguments: the fields that are given by their place; the others are options.
        shows: yields the parts of a reply, each with the lines of text that stand for it; gets the axis, too.
        confirm: asks this first, with `{axis}` in it, unless --yes is given.
    """

    @with_target
    def callback(target: Target, /, axis: str | None = None, *, yes: bool = True, **given: Any) -> None:  # noqa: ANN401
        if not yes and not click.confirm(confirm.format(axis=axis), err=True):
            raise click.Abort
        who = {"client": NAME} if command.about is About.RIG and "client" in command.model_fields else {}
        request = of_options(command, **given, **who)

        async def work(client: RigClient) -> tuple[ReplyT, AxisInfo | None, *tuple[Typed, ...]]:
            if axis is None:
                return await client.ask(request), None
            info = await axis_of(client, axis)
            converted = in_units(request, given, info)
            sent = converted, given, info
            with naming_nearest(sent):
                if isinstance(converted, AxisCommand):
                    return await client.command(axis, converted), info, sent
                return await client.ask(converted, axis), info, sent

        reply, info, *sent = target.run(work)
        refusal = reply.refusal if isinstance(reply, PreviewReply) else None
        nearest = nearest_lines(refusal.code, refusal.value, refusal.nearest, sent) if refusal else ()
        for part, lines in shows(reply, info):
            target.show(part, *lines, *nearest)

    first = [click.Argument(["axis"], type=AXIS)] if command.about is About.AXIS else []
    asks = [click.Option(["--yes"], is_flag=True, help="Do not ask for confirmation.")] if confirm else []
    return _derived(name, command, callback, arguments, first, asks)


def _derived(
    name: str,
    command: type[Command[Frozen]],
    callback: Callable[..., None],
    arguments: tuple[str, ...],
    before: Sequence[click.Parameter],
    behind: Sequence[click.Parameter],
) -> Derived:
    fields = {
        each: described
        for each, described in ((name, command.model_fields[name]) for name in own_fields_first(command))
        if each not in _SENT_BY_ITSELF or (each == LEASE and described.is_required())
    }
    params: list[click.Parameter] = list(before)
    for field, described in fields.items():
        kind, many = (Quantity(), False) if field in DIMENSIONS else _kind(described.annotation)
        if field in arguments:
            params.append(click.Argument([field], type=kind, nargs=-1 if many else 1))
        else:
            params.append(_FieldOption(command, field, kind, many=many))
    target = getattr(callback, "__click_params__", [])
    return Derived(
        name,
        params=[*params, *behind, *reversed(target)],
        callback=callback,
        help=command.summary(),
        context_settings={"ignore_unknown_options": True},  # a value may be negative
    )


LEASE = "lease"
_SENT_BY_ITSELF = frozenset({*AxisCommand.model_fields, "leases"})
"""Fields that prove permission and prevent a second execution."""


class _FieldOption(click.Option):
    """An option for a field; its meaning is read from the source of the class when help is shown."""

    def __init__(self, command: type[Command[Frozen]], field: str, kind: click.ParamType[Any], *, many: bool) -> None:
        described = command.model_fields[field]
        is_flag = described.annotation is bool
        written = (
            field.removesuffix("s") if many else field.removesuffix("_s")
        )  # its meaning says that it is in seconds
        super().__init__(
            [f"--{written.replace('_', '-')}", field],
            type=None if is_flag else kind,
            is_flag=is_flag,
            multiple=many,
            required=described.is_required(),
            envvar="LDCND_LEASE" if field == LEASE else None,
        )
        self._command = command
        self._field = field

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Return how it is written and what it means."""
        self.help = attribute_docstrings(self._command).get(self._field)
        return super().get_help_record(ctx)


class Switch(click.Choice[str]):
    """On or off, for a truth that is given by its place."""

    def __init__(self) -> None:
        super().__init__(["on", "off"])

    @override
    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        return value if isinstance(value, bool) else super().convert(value, param, ctx) == "on"


def _kind(annotation: object) -> tuple[click.ParamType[Any], bool]:
    """Return how a field is written on the command line, and whether it may be written several times."""
    if get_origin(annotation) is tuple:
        return _kind(get_args(annotation)[0])[0], True
    kinds = [each for each in get_args(annotation) or (annotation,) if each is not NoneType]
    kind = kinds[0]
    if isinstance(kind, type) and issubclass(kind, Enum):
        return click.Choice([each.value for each in kind]), False
    if get_origin(annotation) is Literal:
        return click.Choice(kinds), False
    if kind is str:
        return click.STRING, False
    if kind is bool:
        return Switch(), False
    return (WholeNumber() if kind is int else Finite()), False
