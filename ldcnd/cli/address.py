"""The option that says where a command serves."""

from collections.abc import Callable
from typing import TypeVar

import click

from ldcnd.errors import ConfigError
from ldcnd.listen_address import ListenAddress, parse_listen_address

CommandT = TypeVar("CommandT", bound=Callable[..., object])


def address_option(name: str, default: str) -> Callable[[CommandT], CommandT]:
    """Return an option of that name, whose value is a `ListenAddress`; anything but HOST:PORT is wrong usage."""
    return click.option(
        name,
        callback=_parsed,
        default=default,
        show_default=True,
        metavar="HOST:PORT",
        help="Where to serve; port 0 is any.",
    )


def _parsed(_context: click.Context, _parameter: click.Parameter, value: str) -> ListenAddress:
    try:
        return parse_listen_address(value)
    except ConfigError as error:
        raise click.BadParameter(error.message) from error
