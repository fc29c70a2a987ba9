"""What the consoles of a user share: the socket on which one gives another link, and the key that signs their pages.

Both lie in the user's runtime folder, which only that user and root can open; both could read the memory of a console.
"""

import asyncio
import json
import os
import secrets
import socket
import tempfile
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path

from ldcnd.contract.errors import ConfigError
from ldcnd.contract.frozen import Frozen
from ldcnd.listen_address import ListenAddress

ANSWER_S = 5.0
RUNTIME_FOLDERS = ("RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR")
"""Where services and users have a folder of their own for sockets (systemd.exec, XDG base directories)."""
SERVICES = Path("/run/ldcnd-console")
"""Where the services of the package have theirs, each in a folder of its own (deploy/units/beside@.service)."""
PRIVATE = 0o700
PAGE_KEY = "ldcnd-console.key"
KEY_BYTES = 32
EVERY_ADDRESS = ("0.0.0.0", "::")  # noqa: S104 - a console there listens on the address that is asked for
_PREFIX, _SUFFIX = "ldcnd-console-", ".sock"
_ANY = f"{_PREFIX}*-*{_SUFFIX}"


class GivenLink(Frozen):
    """A link that opens a console."""

    link: str
    """The address, with what lets a browser in."""
    minutes: float | None
    """For how long it lets one browser in; null for one that lets in every browser that has it."""


def _folder() -> Path:
    """Return where the consoles of this user give links.

    Raises:
        ConfigError: the folder belongs to another user, or this machine has no such sockets.
    """
    if not hasattr(asyncio, "open_unix_connection"):
        raise ConfigError("consoles give no further links on this machine", remedy="start the console again")
    given = next((Path(os.environ[name].split(":")[0]) for name in RUNTIME_FOLDERS if os.environ.get(name)), None)
    folder = given or Path(tempfile.gettempdir()) / f"ldcnd-{os.getuid()}"
    folder.mkdir(mode=PRIVATE, parents=True, exist_ok=True)
    if folder.stat().st_uid != os.getuid():
        raise ConfigError(f"{folder} belongs to another user: no links of a console are given there")
    return folder


def page_key() -> bytes | None:
    """Return the key that the consoles of this user sign with, one after the other; None where it cannot be kept."""
    try:
        path = _folder() / PAGE_KEY
        with (
            suppress(FileExistsError),
            os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as new,
        ):
            new.write(secrets.token_bytes(KEY_BYTES))
        key = path.read_bytes()
    except (OSError, ConfigError):
        return None
    return key if len(key) == KEY_BYTES else None


def _folders() -> list[Path]:
    """Return where consoles give links to this user; root may ask those that are services."""
    return [_folder(), *(SERVICES.glob("*") if os.getuid() == 0 else ())]


def _name_of(host: str, port: int) -> str:
    """Return the name of the socket of the console that listens on an IP address and a port."""
    return f"{_PREFIX}{host}-{port}{_SUFFIX}"


@asynccontextmanager
async def giving_links(host: str, port: int, new_link: Callable[[], GivenLink]) -> AsyncIterator[None]:
    """Give a link to whoever opens the socket, until the context ends; a console without such a folder gives none.

    Args:
        host: the IP address on which the console listens.
        port: and its port.
        new_link: makes a link.
    """

    async def give(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            writer.write(new_link().model_dump_json().encode() + b"\n")
            await writer.drain()
        writer.close()

    try:
        path = _folder() / _name_of(host, port)
        path.unlink(missing_ok=True)  # of a console that was killed: the address was free
        server = await asyncio.start_unix_server(give, path)
    except (OSError, ConfigError):
        yield
        return
    path.chmod(PRIVATE)
    async with server:
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


async def ask_for_link(address: ListenAddress) -> GivenLink:
    """Return another link of the console that listens at an address of this machine, for this user.

    Raises:
        ConfigError: there is none, or it does not answer.
    """
    folders = _folders()
    names = [_name_of(host, address.port) for host in (_ip_of(address.host), *EVERY_ADDRESS)]
    for path in [folder / name for name in names for folder in folders]:
        try:
            async with asyncio.timeout(ANSWER_S):
                reader, writer = await asyncio.open_unix_connection(path)
                line = await reader.readline()
                writer.close()
            return GivenLink.model_validate(json.loads(line))
        except (OSError, TimeoutError, ValueError):
            continue
    found = [each for folder in folders for each in folder.glob(_ANY)]
    named = (each.name.removeprefix(_PREFIX).removesuffix(_SUFFIX).rpartition("-") for each in found)
    others = ", ".join(sorted(f"{ListenAddress(host, int(port)).in_url}:{port}" for host, _, port in named))
    raise ConfigError(
        f"no console of this user gives links at {address.in_url}:{address.port}"
        f"{f'; there may be one at {others}' if others else ''}",
        value=address.port,
        remedy="name its address with --listen, ask as the user that runs it, or start one: ldcnd console",
    )


def _ip_of(host: str) -> str:
    """Return the IP address on which a console listens that was given this host."""
    try:
        return str(socket.getaddrinfo(host, None, socket.AF_INET6 if ":" in host else socket.AF_INET)[0][4][0])
    except OSError:
        return host
