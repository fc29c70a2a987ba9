"""What a client and a call of the command line load: nothing of the daemon, no serial port, nothing that takes long."""

import subprocess
import sys
from pathlib import Path

import pytest

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
    "sim",
    "transport",
}
OTHERS = {
    "bluesky",
    "caproto",
    "click",
    "cryptography",
    "logging_journald",
    "mcap",
    "prometheus_client",
    "serial",
    "serial_asyncio",
    "uvloop",
}


SLOW_TO_LOAD = {"structlog", "rich", "matplotlib", "textual", "starlette", "hypothesis"}
MODULES_OF_A_CALL = 345
MODELS_OF_CALLS = {
    "stop": 64,
    "why x": 59,
    "lease list": 73,
    "trace channels x": 97,
    "axis list": 64,
    "axis move x 1": 64,
    "axis gains x --kp 1": 64,
    "axis jog x 1 --for 1": 73,
    "group move x=1 y=1": 98,
}
"""The most models that these calls of the command line make; with the modules, two thirds of the time of a call."""
CALL = """
import sys
from ldcnd.cli.main import main
from ldcnd.model.frozen import Frozen

def models(of):
    return sum(1 + models(model) for model in of.__subclasses__())

sys.argv = ["ldcnd", *{words!r}]
try:
    main()
except SystemExit as end:
    print(end.code, models(Frozen), *sys.modules, sep="\\n")
"""


def printed_by(program: str, folder: Path) -> list[str]:
    return subprocess.run(  # noqa: S603 - our own program
        [sys.executable, "-c", program], check=True, capture_output=True, text=True, cwd=folder, timeout=60
    ).stdout.split()


def test_the_client_loads_nothing_of_the_daemon(tmp_path: Path) -> None:
    loaded = printed_by(f"import sys, {', '.join(MODULES)}; print(*sys.modules, sep='\\n')", tmp_path)

    assert set(MODULES) <= set(loaded)
    assert not {f"ldcnd.{name}" for name in OURS} & set(loaded)
    assert not (OTHERS | SLOW_TO_LOAD) & set(loaded)


@pytest.mark.real_time
@pytest.mark.parametrize(("words", "most"), MODELS_OF_CALLS.items())
def test_a_call_of_the_command_line_loads_little(words: str, most: int, tmp_path: Path) -> None:
    code, models, *loaded = printed_by(CALL.format(words=[*words.split(), "-e", "127.0.0.1:1"]), tmp_path)

    print(f"{words}: {len(loaded)} modules, {models} models")
    assert code == "3"
    assert "ldcnd.messaging.zenoh_session" in loaded
    assert not {f"ldcnd.{name}" for name in OURS - {"cli"}} & set(loaded)
    assert not (OTHERS - {"click"} | SLOW_TO_LOAD) & set(loaded)
    assert len(loaded) <= MODULES_OF_A_CALL
    assert int(models) <= most
