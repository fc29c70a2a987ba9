"""Programs beside a daemon as their service manager sees them: started once they serve, and what they lack then."""

import asyncio
import os
import signal
import socket
from asyncio.subprocess import PIPE, Process
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.support.process import LDCND, ROOT, answering, free_port, process
from tests.support.small_disk import fill, small_disk

pytestmark = [pytest.mark.system, pytest.mark.real_time, pytest.mark.timeout(120)]

SIMULATED = str(ROOT / "config" / "simulated.toml")
PATIENCE_S = 40.0
PROGRAMS = {
    "console": ("--listen", "127.0.0.1:{}"),
    "record": ("--out", "{place}/run.mcap"),
    "metrics": ("--address", "127.0.0.1:{}"),
    "epics": ("--address", "127.0.0.1:{}"),
    "secop": ("--address", "127.0.0.1:{}"),
}
NEEDED = {"epics": "caproto", "secop": "frappy"}


class Manager:
    """The service manager's end, and the program that it has started."""

    def __init__(self, heard: socket.socket, program: Process) -> None:
        self.program = program
        self._heard = heard

    async def until(self, wanted: Callable[[str], bool]) -> str:
        """Return the first message that is wanted, of those that come from now on."""
        loop = asyncio.get_running_loop()
        async with asyncio.timeout(PATIENCE_S):
            while not wanted(message := (await loop.sock_recv(self._heard, 4096)).decode()):
                pass
        return message


@asynccontextmanager
async def managed(place: Path, name: str, *more: str) -> AsyncIterator[Manager]:
    """Start a program as a service manager does."""
    words = [word.format(free_port(), place=place) for word in PROGRAMS[name]]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK) as heard:
        heard.bind(str(place / "notify"))
        environment = os.environ | {"NOTIFY_SOCKET": str(place / "notify"), "PYTHONUNBUFFERED": "1"}
        program = await asyncio.create_subprocess_exec(
            *LDCND, name, *words, *more, stdout=PIPE, stderr=asyncio.subprocess.STDOUT, env=environment
        )
        try:
            yield Manager(heard, program)
        finally:
            if program.returncode is None:
                program.kill()
            await program.communicate()


def is_ready(message: str) -> bool:
    return "READY=1" in message.splitlines()


@pytest.mark.parametrize("name", PROGRAMS)
async def test_a_program_is_started_once_it_serves_and_says_when_its_daemon_is_away(name: str, tmp_path: Path) -> None:
    if not find_spec(NEEDED.get(name, "ldcnd")):
        pytest.skip(f"no {NEEDED[name]}")
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with process("run", "--config", SIMULATED, "--listen", endpoint) as daemon:
        await answering(daemon, endpoint)
        async with managed(tmp_path, name, "-e", endpoint) as manager:
            started = await manager.until(is_ready)
            daemon.send_signal(signal.SIGTERM)
            await daemon.wait()
            lacking = await manager.until(lambda message: "is heard" in message)
            async with process("run", "--config", SIMULATED, "--listen", endpoint):
                again = await manager.until(lambda message: "is heard" not in message)
            manager.program.send_signal(signal.SIGTERM)
            said, _ = await manager.program.communicate()

    what = started.partition("STATUS=")[2]
    assert what
    assert lacking.startswith("STATUS=no daemon")
    assert f"cannot connect to {endpoint}" in lacking
    assert again == f"STATUS={what}"
    assert f"cannot connect to {endpoint}" in said.decode()
    assert manager.program.returncode == 0


async def test_a_console_gives_another_link_as_soon_as_it_counts_as_started(tmp_path: Path) -> None:
    async with managed(tmp_path, "console", "-e", f"tcp/127.0.0.1:{free_port()}") as manager:
        await manager.until(is_ready)
        manager.program.send_signal(signal.SIGUSR1)
        assert manager.program.stdout
        links = set[bytes]()
        async with asyncio.timeout(PATIENCE_S):
            while len(links) < 2:
                line = await manager.program.stdout.readline()
                assert line, "the console has ended"
                links |= {line} if b"?link=" in line else set()


@pytest.mark.parametrize("name", ["record", "metrics"])
async def test_a_program_that_cannot_begin_says_why(name: str, tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    async with managed(tmp_path, name, "-e", endpoint) as manager:
        why = await manager.until(lambda message: message.startswith("STATUS="))
        await manager.program.communicate()

    assert why == f"STATUS=cannot connect to {endpoint}"
    assert manager.program.returncode == 3


async def test_a_recorder_without_room_names_the_place_and_what_to_do(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with small_disk(tmp_path / "disk", 64 * 1024) as disk:
        fill(disk)
        async with process("run", "--config", SIMULATED, "--listen", endpoint) as daemon:
            await answering(daemon, endpoint)
            async with managed(tmp_path, "record", "-e", endpoint, "--out", str(disk / "run.mcap")) as manager:
                told = await manager.until(lambda message: message.startswith("STATUS="))
                said, _ = await manager.program.communicate()

    assert f"No space left on device; make room in {disk}" in told
    assert f"{disk}/run.mcap" in told
    assert told.removeprefix("STATUS=") in said.decode()
    assert manager.program.returncode == 1
