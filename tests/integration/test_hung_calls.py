"""Drivers and disks that hang: what they must not hold up, seen in processes of their own."""

import asyncio
import signal
import sys
import textwrap
from asyncio.subprocess import PIPE

import pytest

from ldcnd.contract.commands import MoveVelocity, Power
from tests.support.process import END_TIME_S, ROOT, answering, client, free_port

pytestmark = pytest.mark.real_time

OPENINGS = """
    import asyncio, contextlib, os, pty, sys, time
    from pathlib import Path
    from ldcnd.axis.kept import KeptFiles, KeptLatch
    from ldcnd.contract.errors import TransportLost
    from ldcnd.line.serial_port import SerialSettings, open_serial_port


    async def main(folder: Path) -> None:
        # a lock that is a pipe without a writer: to open it waits for ever, as in a driver that hangs
        hung = []
        for number in range(40):
            (folder / f"port{number}").symlink_to("/dev/null")
            os.mkfifo(folder / f"port{number}.lock")
            hung.append(folder / f"port{number}")
        for port in hung:
            for _ in range(2):  # the line tries again
                with contextlib.suppress(TimeoutError, TransportLost):
                    async with asyncio.timeout(0.01):
                        await open_serial_port(SerialSettings(str(port), 19_200))
        _, slave = pty.openpty()
        async with asyncio.timeout(3.0):
            port = await open_serial_port(SerialSettings(os.ttyname(slave), 19_200))
            await KeptFiles(folder, "bench", {}).keep_latches({"x": KeptLatch(stopped=True)})
            await port.close()
        print("done", flush=True)


    asyncio.run(main(Path(sys.argv[1])))
"""


async def test_openings_that_hang_hold_up_no_other_line_no_latch_and_no_end(tmp_path):
    running = await asyncio.create_subprocess_exec(
        sys.executable, "-c", textwrap.dedent(OPENINGS), str(tmp_path), cwd=ROOT, stdout=PIPE
    )
    try:
        async with asyncio.timeout(30.0):
            said, _ = await running.communicate()
    finally:
        if running.returncode is None:
            running.kill()
            await running.wait()

    assert (said, running.returncode) == (b"done\n", 0)


HUNG_DISK = """
    import os, signal, time
    from ldcnd.cli.main import main

    sync = os.fsync
    hung = []
    os.fsync = lambda descriptor: time.sleep(3600) if hung else sync(descriptor)
    signal.signal(signal.SIGUSR1, lambda *_: hung.append(True))
    main()
"""
"""A daemon whose disk hangs from a signal on."""


@pytest.mark.long
async def test_a_disk_that_hangs_keeps_no_daemon_from_bringing_axes_to_rest_and_ending(tmp_path):
    config, endpoint = tmp_path / "rig.toml", f"tcp/127.0.0.1:{free_port()}"
    simulated = (ROOT / "config" / "simulated.toml").read_text()
    config.write_text(simulated.replace("\n[", f'\nstate_dir = "{tmp_path / "state"}"\n\n[', 1))
    command = (sys.executable, "-c", textwrap.dedent(HUNG_DISK), "run", "--config", str(config), "--listen", endpoint)
    running = await asyncio.create_subprocess_exec(*command, cwd=ROOT, stderr=PIPE)
    try:
        await answering(running, endpoint)
        async with client(endpoint) as rig:
            await rig.command("x", Power(on=True))
            await rig.command("x", MoveVelocity(velocity=1.0))
            running.send_signal(signal.SIGUSR1)
            await rig.stop("y")
        running.send_signal(signal.SIGTERM)
        async with asyncio.timeout(END_TIME_S):
            _, said = await running.communicate()
    finally:
        if running.returncode is None:
            running.kill()
            await running.wait()

    assert running.returncode == 0
    assert b"aborted by halt" in said
