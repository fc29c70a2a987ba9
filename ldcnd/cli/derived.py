"""Commands of the command line that are made of the class of what they send: its fields, their texts and limits."""

from enum import Enum
from types import NoneType
from typing import Any, get_args

import click

from ldcnd.cli.connection import AXIS, of_options
from ldcnd.cli.sending import Sender, Sent, commanding
from ldcnd.cli.typed import Finite, Whole
from ldcnd.contract.commands import AxisCommand
from ldcnd.contract.frozen import attribute_docstrings


def derived(name: str, command: type[Sent], *arguments: str, moves: bool = False) -> click.Command:
    """Return a command that sends one class to an axis.

    Args:
        name: what it is called.
        command: what it sends.
        arguments: the fields that are given by their place; the others are options.
        moves: it moves the axis, so it can be waited for.
    """

    @commanding
    def callback(sender: Sender, /, axis: str, *, wait: bool = False, **given: Any) -> None:  # noqa: ANN401 - click's own
        sender.send(axis, of_options(command, **given), wait=wait)

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
        params.append(click.Option(["--wait"], is_flag=True, help="Return when it has ended; Ctrl-C halts the axis."))
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
        super().__init__([f"--{field.replace('_', '-')}"], type=None if is_flag else kind, is_flag=is_flag)
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
    return Whole() if kind is int else Finite()
