"""Where a program of the command line serves: the option, and where the console is unless that says otherwise."""

from collections.abc import Callable
from typing import TypeVar

import click

from ldcnd.contract.errors import ConfigError
from ldcnd.listen_address import ListenAddress, parse_listen_address

CONSOLE_ADDRESS = "127.0.0.1:8470"
CommandT = TypeVar("CommandT", bound=Callable[..., object])


def address_option(name: str, default: str) -> Callable[[CommandT], CommandT]:
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
