"""How commands reach axes: checked names, one lease, the reply in units, and a wait whose end halts what was begun."""

import asyncio
import sys
from collections.abc import AsyncIterator, Callable, Sequence
from contextlib import asynccontextmanager, nullcontext, suppress
from enum import Enum
from functools import wraps
from types import NoneType
from typing import Any, get_args

import click

from ldcnd.cli.connection import AXIS, Target, of_options, with_target
from ldcnd.cli.output import FAILED, UNREACHABLE, end_as_interrupted, show_error, show_lines, show_passing
from ldcnd.cli.quantities import number, outcome, values_of
from ldcnd.cli.typed import Finite, WholeNumber, axis_of
from ldcnd.client.motion import failure
from ldcnd.client.rig_client import RigClient, Samples
from ldcnd.contract.commands import AxisCommand, CommandReply, Halt, Verb
from ldcnd.contract.errors import LdcndError, SessionError, UnknownAxis
from ldcnd.contract.events import CommandStatus, ReadOutcome
from ldcnd.contract.frozen import attribute_docstrings
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.samples import PositionSample, StateSample, TelemetryItem

HALT_TIME_S = 3.0
NAME = "ldcnd"
"""Under this name the command line is found in events unless a lease says another."""

Sent = AxisCommand[CommandReply]


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

    def send(self, axis: str, command: Sent, *, wait: bool = False, leave_running: bool = False) -> None:
        """Send one command and show its reply; with `wait` return when it has ended.

        Ctrl-C, SIGTERM and the end of the terminal halt an axis that is waited for, unless it is to be left running.
        """
        if wait:
            end_as_interrupted()
        elif command.takes_energy_out:
            self.send_to_all((axis,), command, "accepted")
            return

        async def work(client: RigClient) -> tuple[StateSample, str] | None:
            info = await axis_of(client, axis)
            async with halting(client, info, leave_running=leave_running) if wait else nullcontext():
                reply = await self.command(client, axis, command)
                words = command.verb.replace("_", " ")
                waits = f", waits until {reply.waits_for} has ended" if reply.waits_for else ""
                said = f"{axis}: {words} accepted{values_of(reply, info)}{waits}"
                try:
                    self.target.show(reply, said)
                except OSError:
                    if not wait:
                        show_lines(f"{said}; it goes on, `ldcnd axis halt {axis}` halts it", err=True)
                    raise
                if not wait:
                    return None
                state = await _follow(client, info, reply)
                ended = await client.ask(ReadOutcome(command_id=reply.command_id))
                if reply.waits_for and ended.status is not CommandStatus.DONE:
                    raise failure(ended)
                return state, outcome(info, ended, state)

        ended = self.target.run(work)
        if ended is None:
            return
        state, said = ended
        self.target.show(state, said)
        if state.last_error is not None:
            sys.exit(FAILED)

    def send_to_all(self, axes: Sequence[str], command: Sent, said: str = "done") -> None:
        """Send one command to several axes, all that take it when none is named; tell how it went with each.

        What takes energy out goes to every rig that can be reached unless one is named: it asks no question first.
        """

        async def work(client: RigClient) -> list[CommandReply | LdcndError]:
            known = [info for info in await client.axes() if Verb(command.verb) in info.capabilities]
            for axis in axes:
                await axis_of(client, axis)
            wanted = axes or [info.axis for info in known]
            async with asyncio.TaskGroup() as group:
                tasks = [group.create_task(self._outcome(client, axis, command), name=axis) for axis in wanted]
            return [task.result() for task in tasks]

        if not command.takes_energy_out:
            reached = {"": self.target.run(work)}
        else:
            on_each = self.target.run_on_each(work)
            there = {rig: made for rig, made in on_each.items() if not isinstance(made, UnknownAxis)} or on_each
            reached = {
                f"{rig}: " if len(on_each) > 1 else "": [made] if isinstance(made, LdcndError) else made
                for rig, made in there.items()
            }
        for whose, outcomes in reached.items():
            for each in outcomes:
                if isinstance(each, LdcndError):
                    show_error(each, whose)
                else:
                    self.target.show(each, f"{whose}{each.axis}: {each.verb.replace('_', ' ')} {said}")
        failures = [each for outcomes in reached.values() for each in outcomes if isinstance(each, LdcndError)]
        if failures:
            sys.exit(UNREACHABLE if all(isinstance(each, SessionError) for each in failures) else FAILED)

    async def command(self, client: RigClient, axis: str, command: Sent) -> CommandReply:
        """Send one command, under the lease if there is one."""
        named = command.model_copy(update={"lease": self.lease, "client": None if self.lease else NAME})
        return await client.command(axis, named)

    async def _outcome(self, client: RigClient, axis: str, command: Sent) -> CommandReply | LdcndError:
        try:
            return await self.command(client, axis, command)
        except LdcndError as error:
            return error


@asynccontextmanager
async def halting(client: RigClient, info: AxisInfo, *, leave_running: bool = False) -> AsyncIterator[None]:
    """Halt an axis, and say so, if anything but an answer of the daemon cuts the context short, such as Ctrl-C.

    Or say that it is left running.
    """
    axis = info.axis
    try:
        yield
    except LdcndError:
        raise
    except BaseException:
        said = f"{axis} is left running; `ldcnd axis halt {axis}` halts it" if leave_running else None
        said = said or await halted(client, info)
        with suppress(OSError):  # the terminal may be what has gone
            show_lines(said, err=True)
        raise


async def halted(client: RigClient, info: AxisInfo) -> str:
    """Halt an axis and wait until it is at rest; return the outcome in words."""
    try:
        async with asyncio.timeout(HALT_TIME_S):
            reply = await client.command(info.axis, Halt(client=NAME), HALT_TIME_S)
            await client.wait_for_end(info.axis, reply.command_id)
            position = await client.last(info.axis, TelemetryItem.POSITION)
    except (TimeoutError, LdcndError) as error:
        return f"{info.axis}: NOT confirmed at rest: {str(error) or 'it still moves'}; `ldcnd stop` stops every axis"
    at = f" at {number(position.value, info)}" if isinstance(position, PositionSample) else ""
    return f"{info.axis}: halted{at}"


async def _follow(client: RigClient, info: AxisInfo, reply: CommandReply) -> StateSample:
    """Return the state after a command; on a terminal show where the axis is meanwhile."""
    async with client.samples(info.axis, TelemetryItem.POSITION) as positions, asyncio.TaskGroup() as group:
        showing = group.create_task(_show(info, positions), name="progress")
        try:
            return await client.wait_for_end(info.axis, reply.command_id)
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


def derived(name: str, command: type[Sent], *arguments: str, moves: bool = False) -> click.Command:
    """Return a command that sends one class to an axis.

    Args:
        name: what it is called.
        command: what it sends.
        arguments: the fields that are given by their place; the others are options.
        moves: it moves the axis, so it can be waited for.
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
        sender.send(axis, of_options(command, **given), wait=wait, leave_running=leave_running)

    params: list[click.Parameter] = [click.Argument(["axis"], type=AXIS)]
    for field, described in command.model_fields.items():
        if field in AxisCommand.model_fields:
            continue
        kind = _kind(described.annotation)
        if field in arguments:
            params.append(click.Argument([field], type=kind))
        else:
            params.append(_FieldOption(command, field, kind))
    if moves:
        params += [click.Option([name], is_flag=True, help=text) for name, text in WAITING.items()]
    target = getattr(callback, "__click_params__", [])
    return click.Command(
        name,
        params=[*params, *reversed(target)],
        callback=callback,
        help=command.summary(),
        context_settings={"ignore_unknown_options": True},  # a value may be negative
    )


class _FieldOption(click.Option):
    """An option for a field; its meaning is read from the source of the class when help is shown."""

    def __init__(self, command: type[Sent], field: str, kind: click.ParamType[Any]) -> None:
        is_flag = command.model_fields[field].annotation is bool
        name = f"--{field.removesuffix('_s').replace('_', '-')}"  # its meaning says that it is in seconds
        super().__init__([name, field], type=None if is_flag else kind, is_flag=is_flag)
        self._command = command
        self._field = field

    def get_help_record(self, ctx: click.Context) -> tuple[str, str] | None:
        """Return how it is written and what it means."""
        self.help = attribute_docstrings(self._command).get(self._field)
        return super().get_help_record(ctx)


def _kind(annotation: object) -> click.ParamType[Any]:
    """Return how a field is written on the command line."""
    kinds = [each for each in get_args(annotation) or (annotation,) if each is not NoneType]
    kind = kinds[0]
    if isinstance(kind, type) and issubclass(kind, Enum):
        return click.Choice([each.value for each in kind])
    return WholeNumber() if kind is int else Finite()
