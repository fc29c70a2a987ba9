"""Clients run where POSIX is not: its modules and functions are hidden, and the platform calls itself win32."""

import asyncio
import json
import sys
from asyncio.subprocess import PIPE

import pytest

from tests.support.process import ROOT, daemon

WINDOWS = """
import asyncio, json, os, pkgutil, signal, socket, sys
import caproto.asyncio.server, click, concurrent.futures.process, cryptography, getpass, matplotlib.pyplot
import multiprocessing.util, prometheus_client, pytest, serial, serial_asyncio, starlette, structlog, textual.app
import uvicorn, zenoh

POSIX = {"fcntl", "termios", "pty", "tty", "pwd", "grp", "resource", "syslog", "readline", "curses"}

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name in POSIX:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

def refuse(*_):
    raise NotImplementedError

sys.meta_path.insert(0, Absent())
for name in POSIX:
    sys.modules.pop(name, None)
for name in ("O_DIRECTORY", "fchown", "fchmod", "getuid", "openpty", "sched_setscheduler", "sched_yield"):
    delattr(os, name)
for name in ("SIGHUP", "SIGUSR1", "SIGKILL"):
    delattr(signal, name)
asyncio.SelectorEventLoop.add_signal_handler = refuse
sys.platform = "win32"
"""
IMPORT_ALL = """
import importlib, ldcnd

HERE = {"ldcnd.sim.pty", "ldcnd.line.serial_port", "ldcnd.line.line_discipline", "ldcnd.line.terminal_link"}
failed = {}
for module in pkgutil.walk_packages(ldcnd.__path__, "ldcnd."):
    if module.name in HERE or module.name == "ldcnd.__main__":
        continue
    try:
        importlib.import_module(module.name)
    except ModuleNotFoundError as error:
        if error.name in POSIX:
            failed[module.name] = str(error)
    except Exception as error:
        failed[module.name] = repr(error)
print(json.dumps(failed))
"""
RUN = """
from ldcnd.cli.main import main

sys.argv = ["ldcnd", *json.loads(sys.argv[1])]
main()
"""

pytestmark = pytest.mark.real_time


async def printed_by(program, *words):
    running = await asyncio.create_subprocess_exec(
        sys.executable, "-c", WINDOWS + program, json.dumps(words), stdout=PIPE, stderr=PIPE, cwd=ROOT
    )
    async with asyncio.timeout(50):
        printed, errors = await running.communicate()
    return running.returncode, printed.decode(), errors.decode()


async def test_all_but_the_ports_can_be_imported():
    code, printed, errors = await printed_by(IMPORT_ALL)

    assert (code, json.loads(printed or "null")) == (0, {}), errors


@pytest.mark.system
async def test_a_rig_is_looked_at_moved_and_stopped():
    async with daemon(ROOT / "config" / "simulated.toml") as endpoint:
        for words in (["list"], ["power", "on", "x"], ["move", "x", "0.1", "--wait"], ["stop"]):
            code, printed, errors = await printed_by(RUN, *words, "-e", endpoint)

            assert code == 0, (words, printed, errors)


@pytest.mark.long
async def test_a_key_that_is_held_is_refused_in_one_sentence():
    code, printed, _ = await printed_by(
        """
from ldcnd.cli.output import keys
from ldcnd.contract.errors import ConfigError

async def hold():
    with keys():
        pass

try:
    asyncio.run(hold())
except ConfigError as error:
    print(error.remedy)
"""
    )

    assert (code, "--for SECONDS" in printed) == (0, True)
