"""Where a command serves: HOST:PORT."""

from dataclasses import dataclass

import click

LARGEST_PORT = 65_535


@dataclass(frozen=True, slots=True)
class Address:
    """A host, without the brackets of IPv6, and a port; 0 stands for one that is free."""

    host: str
    port: int


def parse_address(_context: click.Context, _parameter: click.Parameter, value: str) -> Address:
    """Return the address that an option names."""
    host, _, port = value.rpartition(":")
    if not host or not port.isdecimal() or int(port) > LARGEST_PORT:
        raise click.BadParameter(f"{value!r} is not HOST:PORT")
    return Address(host.strip("[]"), int(port))
