"""The socket on which a console gives another link to its own user, so that nothing has to be stopped for one.

It lies in the user's runtime folder, where nobody else may look: whoever can open it could read the console's memory.
"""

import asyncio
import json
import os
import tempfile
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path

from ldcnd.contract.errors import ConfigError
from ldcnd.contract.frozen import Frozen

ANSWER_S = 5.0
RUNTIME_FOLDERS = ("RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR")
"""Where services and users have a folder of their own for sockets (systemd.exec, XDG base directories)."""
PRIVATE = 0o700


class GivenLink(Frozen):
    """A link that opens a console."""

    link: str
    """The address, with what lets a browser in."""
    minutes: float | None
    """For how long it lets one browser in; null for one that lets in every browser that has it."""


def socket_of(port: int) -> Path:
    """Return where the console that listens on a port gives links.

    Raises:
        ConfigError: the folder for it belongs to another user, or this machine has no such sockets.
    """
    if not hasattr(asyncio, "open_unix_connection"):
        raise ConfigError("consoles give no further links on this machine", remedy="start the console again")
    given = next((Path(os.environ[name].split(":")[0]) for name in RUNTIME_FOLDERS if os.environ.get(name)), None)
    folder = given or Path(tempfile.gettempdir()) / f"ldcnd-{os.getuid()}"
    folder.mkdir(mode=PRIVATE, parents=True, exist_ok=True)
    if folder.stat().st_uid != os.getuid():
        raise ConfigError(f"{folder} belongs to another user: no links of a console are given there")
    return folder / f"ldcnd-console-{port}.sock"


@asynccontextmanager
async def giving_links(port: int, new_link: Callable[[], GivenLink]) -> AsyncIterator[None]:
    """Give a link to whoever opens the socket, until the context ends; a console without such a folder gives none."""

    async def give(_: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with suppress(OSError):
            writer.write(new_link().model_dump_json().encode() + b"\n")
            await writer.drain()
        writer.close()

    try:
        path = socket_of(port)
        path.unlink(missing_ok=True)  # of a console that was killed: the port was free
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


async def ask_for_link(port: int) -> GivenLink:
    """Return another link of the console that runs on a port of this machine, for this user.

    Raises:
        ConfigError: there is none, or it does not answer.
    """
    try:
        async with asyncio.timeout(ANSWER_S):
            reader, writer = await asyncio.open_unix_connection(socket_of(port))
            line = await reader.readline()
            writer.close()
        return GivenLink.model_validate(json.loads(line))
    except (OSError, TimeoutError, ValueError) as error:
        raise ConfigError(
            f"no console of this user gives links for port {port}",
            value=port,
            remedy="name its port with --listen, ask as the user that runs it, or start one: ldcnd console",
        ) from error
