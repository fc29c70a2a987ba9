"""Typed input: files, and numbers as `ldcnd.contract.number_text` reads them."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import click
from typing_extensions import override

from ldcnd.contract.errors import ConfigError
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.number_text import NotANumber, behind_number, read_number, read_whole
from ldcnd.contract.units import DIMENSIONS, Dimension, read_quantity
from ldcnd.listen_address import ListenAddress, parse_listen_address

CommandT = TypeVar("CommandT", bound=Frozen)


class TypedNumber(float):
    """A number of an axis as it was typed, with its unit if it has one; the axis says what it is in its own unit."""

    text: str


def number_of(text: str, written: str) -> TypedNumber:
    """Return the number in a part of an argument, with its unit; wrong usage if it is none.

    Args:
        text: the part.
        written: the argument that it is of, for the message.
    """
    try:
        return typed_number(text)
    except NotANumber as error:
        raise click.UsageError(f"{written!r}: {error}") from None


def reads_as_one(places: str) -> bool:
    """Tell whether two numbers with a comma between them can be meant for one with a decimal comma."""
    first, _, second = places.partition(",")
    whole = first.strip().lstrip("+-\u2212").isdigit() and second[:1].isdigit()
    return whole and not {",", "."} & set(second)


class Finite(click.FloatRange):
    """A number, within limits if there are any."""

    name = "number"

    def convert(self, value: float | str, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return it; wrong usage if it is none."""
        try:
            number = read_number(value) if isinstance(value, str) else value
        except NotANumber as error:
            self.fail(f"{error}.", param, ctx)
        return float(super().convert(number, param, ctx))

    def _describe_range(self) -> str:
        """Return its limits for help; nothing without limits."""
        return "" if self.min is None and self.max is None else super()._describe_range()


class Quantity(Finite):
    """A position, distance, velocity or acceleration of an axis; a unit may stand behind it."""

    name = "quantity"

    @override
    def convert(self, value: float | str, param: click.Parameter | None, ctx: click.Context | None) -> float:
        try:
            number = typed_number(str(value))
        except NotANumber as error:
            self.fail(f"{error}.", param, ctx)
        super().convert(float(number), param, ctx)  # its sign is the same in every unit
        return number


def typed_number(text: str) -> TypedNumber:
    """Return a number with any unit, or none.

    Raises:
        NotANumber: it is none.
    """
    number = TypedNumber(read_number(text, *filter(None, [behind_number(text)])))
    number.text = text
    return number


def in_units(command: CommandT, given: Mapping[str, object], info: AxisInfo) -> CommandT:
    """Return a command with its numbers in units of the axis, from what was typed.

    Raises:
        click.BadParameter: a unit does not fit; names those that do.
    """

    def read(name: str, value: object) -> object:
        if isinstance(value, tuple):
            return tuple(read(name, each) for each in value)
        return in_unit(value, name, info, DIMENSIONS[name]) if isinstance(value, TypedNumber) else value

    return command.model_copy(update={name: read(name, given[name]) for name in given if name in DIMENSIONS})


def in_unit(value: TypedNumber, name: str, info: AxisInfo, dimension: Dimension) -> float:
    """Return a number in units of an axis, from what was typed.

    Raises:
        click.BadParameter: its unit does not fit; names those that do.
    """
    try:
        return read_quantity(value.text, info, dimension)
    except NotANumber as error:
        raise click.BadParameter(f"{error}.", param_hint=name.replace("_", "-")) from None


class WholeNumber(click.IntRange):
    """A whole number, within limits if there are any."""

    def convert(self, value: int | str, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Return it; wrong usage if it is none."""
        try:
            number = read_whole(value) if isinstance(value, str) else value
        except NotANumber as error:
            self.fail(f"{error}.", param, ctx)
        return int(super().convert(number, param, ctx))

    def _describe_range(self) -> str:
        """Return its limits for help; nothing without limits."""
        return "" if self.min is None and self.max is None else super()._describe_range()


_FORCE = "ldcnd.force"


class NewFile(click.Path):
    """A file that a command writes: one that is there already may be the only copy of what it holds, and is kept.

    A terminal, a pipe or another device is written to; `force_option` lets a file be written over.
    """

    def __init__(self) -> None:
        super().__init__(path_type=Path, dir_okay=False)

    @override
    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Path:
        path = Path(os.fsdecode(super().convert(value, param, ctx)))
        if path.is_file() and not (ctx and ctx.meta.get(_FORCE)):
            self.fail(f"{path} is there already; give another name, or --force to write over it", param, ctx)
        if not path.parent.is_dir():
            self.fail(f"there is no folder {path.parent} to write {path.name} to", param, ctx)
        return path


class ForceOption(click.Option):
    """Lets a command write over the file that it is given as a `NewFile`."""

    def __init__(self, *_declared: object, **_given: object) -> None:
        super().__init__(
            ["--force"],
            is_flag=True,
            is_eager=True,
            expose_value=False,
            callback=_keep_force,
            help="Write over the file if it is there.",
        )


def _keep_force(context: click.Context, _parameter: click.Parameter, force: bool) -> None:  # noqa: FBT001 - click's
    context.meta[_FORCE] = force


force_option = click.option("--force", cls=ForceOption)


def is_file(name: str) -> bool:
    """Tell whether a name that may be of an axis or of a line is that of a file: those have neither dot nor slash."""
    return "." in name or "/" in name


CONFIGURATION = click.Path(path_type=Path, readable=False)
"""Configuration file. Its reader reports an unreadable one as a configuration that cannot work, exit code 78; click
would report wrong usage, exit code 2, after which a service manager tries again."""
CONSOLE_ADDRESS = "127.0.0.1:8470"
OptionT = TypeVar("OptionT", bound=Callable[..., object])


def address_option(name: str, default: str) -> Callable[[OptionT], OptionT]:
    """Return an option of that name, whose value is a `ListenAddress`; anything but HOST:PORT is wrong usage."""
    return click.option(
        name,
        callback=parsed_address,
        default=default,
        show_default=True,
        metavar="HOST:PORT",
        help="Where to serve; port 0 is any.",
    )


def parsed_address(_context: click.Context, _parameter: click.Parameter, value: str | None) -> ListenAddress | None:
    """Return what is written as HOST:PORT; None for nothing."""
    if value is None:
        return None
    try:
        return parse_listen_address(value)
    except ConfigError as error:
        raise click.BadParameter(error.message) from error
