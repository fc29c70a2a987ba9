"""What a client, a call of the command line and a daemon load: nothing of another's, and nothing that takes long."""

import subprocess
import sys
from pathlib import Path

import pytest

from ldcnd.drives.known import DEFAULT, HOMES
from tests.support.process import ROOT

CLIENT = ROOT / "ldcnd" / "client"
MODULES = sorted(f"ldcnd.client.{file.stem}" for file in CLIENT.glob("[!_]*.py"))
OURS = {
    "bluesky",
    "bus",
    "cli",
    "config",
    "daemon",
    "drivers",
    "epics",
    "exchange",
    "metrics",
    "pki",
    "recording",
    "secop",
    "sim",
    "transport",
}
OTHERS = {
    "bluesky",
    "caproto",
    "click",
    "cryptography",
    "frappy",
    "logging_journald",
    "mcap",
    "p4p",
    "prometheus_client",
    "pyarrow",
    "serial",
    "serial_asyncio",
    "uvloop",
}


SLOW_TO_LOAD = {"structlog", "rich", "matplotlib", "textual", "starlette", "hypothesis"}
CALLS = ("stop", "trace take x", "group move x=1 y=1", "bus list")
CALL = """
import sys
from ldcnd.cli.main import main

sys.argv = ["ldcnd", *{words!r}]
try:
    main()
except SystemExit as end:
    print(end.code, *sys.modules, sep="\\n")
"""
BESIDE_A_DAEMON = {"bench", "bluesky", "console", "lab", "ops"}
DAEMON = """
import asyncio, sys, time
from pathlib import Path
from ldcnd.cli import main, run
from ldcnd.config.rig import load_config
from ldcnd.daemon.assembly import build_daemon
from ldcnd.contract.frozen import Frozen
from ldcnd.testing.memory_session import MemoryBroker
from ldcnd.config.plan import require_plan

async def build(config):
    require_plan(config)
    async with MemoryBroker().session() as session:
        build_daemon(config, session, time.time_ns, "test")

made = []
Frozen.model_json_schema = lambda *_, **__: made.append(1)
asyncio.run(build(load_config(Path({rig!r}))))
print(len(made), *sys.modules, sep="\\n")
"""


def printed_by(program: str, folder: Path) -> list[str]:
    return subprocess.run(  # noqa: S603 - our own program
        [sys.executable, "-c", program], check=True, capture_output=True, text=True, cwd=folder, timeout=60
    ).stdout.split()


@pytest.mark.long
def test_the_client_loads_nothing_of_the_daemon(tmp_path: Path) -> None:
    loaded = printed_by(f"import sys, {', '.join(MODULES)}; print(*sys.modules, sep='\\n')", tmp_path)

    assert set(MODULES) <= set(loaded)
    assert not {f"ldcnd.{name}" for name in OURS} & set(loaded)
    assert not (OTHERS | SLOW_TO_LOAD) & set(loaded)


@pytest.mark.real_time
@pytest.mark.parametrize("words", CALLS)
@pytest.mark.sweep(3)
def test_a_call_of_the_command_line_loads_little(words: str, tmp_path: Path) -> None:
    code, *loaded = printed_by(CALL.format(words=[*words.split(), "-e", "127.0.0.1:1"]), tmp_path)

    assert code == "3"
    assert "ldcnd.net.zenoh_session" in loaded
    assert not {f"ldcnd.{name}" for name in OURS - {"cli"}} & set(loaded)
    assert not (OTHERS - {"click"} | SLOW_TO_LOAD) & set(loaded)


@pytest.mark.long
def test_a_daemon_loads_one_family_and_generates_no_schema(tmp_path: Path) -> None:
    schemas, *loaded = printed_by(DAEMON.format(rig=str(ROOT / "config" / "simulated.toml")), tmp_path)

    assert schemas == "0"
    assert [home for home in HOMES.values() if home.partition(":")[0] in loaded] == [HOMES[DEFAULT]]
    assert not {f"ldcnd.{name}" for name in BESIDE_A_DAEMON} & set(loaded)
    assert not (OTHERS - {"click", "serial", "serial_asyncio"} | SLOW_TO_LOAD - {"structlog"}) & set(loaded)
