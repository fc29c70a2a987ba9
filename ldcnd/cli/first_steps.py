"""`ldcnd run --console`: the console beside the daemon, and what to type next once the rig is up."""

import asyncio
import contextlib
import json
import shlex
import sys
from asyncio.subprocess import PIPE, Process
from collections.abc import AsyncIterator
from pathlib import Path

from ldcnd.cli.connection import DEFAULT_ENDPOINT
from ldcnd.cli.output import show_lines
from ldcnd.config.rig import RigConfig
from ldcnd.daemon.daemon import Daemon
from ldcnd.listen_address import ListenAddress

LINK_S = 20.0
"""Longest time that the console takes to print its link."""
END_S = 5.0


async def show_first_steps(daemon: Daemon, rig: RigConfig, address: ListenAddress) -> None:
    """Wait until the lines are up, serve the console, say what to type next; until cancelled.

    Args:
        daemon: the daemon that starts.
        rig: its configuration.
        address: where the console serves.
    """
    endpoint = next(iter(rig.zenoh.listen), DEFAULT_ENDPOINT)
    await daemon.wait_up()
    async with _console(endpoint, address) as link:
        show_lines(*first_steps(rig, endpoint, link))
        await asyncio.Event().wait()


def first_steps(rig: RigConfig, endpoint: str, link: str | None) -> list[str]:
    """Return the lines that a newcomer reads."""
    axes = [axis for bus in rig.bus for axis in bus.axis]
    program = _program()
    at = "" if endpoint == DEFAULT_ENDPOINT else f" -e {shlex.quote(endpoint)}"
    lines = ["", f"Rig {rig.rig} is up: {', '.join(axis.name for axis in axes)}. Nothing moves unless you ask for it."]
    lines += ["In a second terminal:", f"  {program} axis list{at}"]
    if movable := next((axis.name for axis in axes if axis.reference == "at_reset"), None):
        lines += [f"  {program} axis power {movable} on{at}", f"  {program} axis move {movable} 10 --wait{at}"]
    lines += [f"  {program} stop{at}    # at any time; software, not an emergency stop"]
    lines += [f"In a browser, within ten minutes: {link}"] if link else ["No console serves; `ldcnd console` says why."]
    return [*lines, "Ctrl-C here ends it; what moves is brought to rest first.", ""]


def _program() -> str:
    """Return how this program was called, so that what is printed can be typed."""
    called = Path(sys.argv[0])
    with contextlib.suppress(ValueError):
        return str(called.resolve().relative_to(Path.cwd())) if called.name == "ldcnd" else "ldcnd"
    return "ldcnd"


@contextlib.asynccontextmanager
async def _console(endpoint: str, address: ListenAddress) -> AsyncIterator[str | None]:
    """Run a console until the context ends; with its link, or None when it does not serve: the daemon goes on."""
    words = ("-m", "ldcnd", "console", "--json", "-e", endpoint, "--listen", f"{address.in_url}:{address.port}")
    try:
        console = await asyncio.create_subprocess_exec(sys.executable, *words, stdout=PIPE)
    except OSError:
        yield None
        return
    try:
        yield await _link(console)
    finally:
        with contextlib.suppress(ProcessLookupError):
            console.terminate()
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(END_S):
                await console.wait()


async def _link(console: Process) -> str | None:
    assert console.stdout  # noqa: S101 - it is piped
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(LINK_S):
            if line := await console.stdout.readline():
                return str(json.loads(line)["link"])
    return None
