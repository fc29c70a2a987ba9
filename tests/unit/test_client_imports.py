"""What a program loads that only wants to be a client: nothing of the daemon, and no serial port."""

import subprocess
import sys
from pathlib import Path

from tests.support.process import ROOT

CLIENT = ROOT / "ldcnd" / "client"
MODULES = sorted(f"ldcnd.client.{file.stem}" for file in CLIENT.glob("[!_]*.py"))
OURS = {"bus", "cli", "config", "daemon", "drivers", "exchange", "metrics", "pki", "recording", "sim", "transport"}
OTHERS = {
    "click",
    "cryptography",
    "logging_journald",
    "mcap",
    "prometheus_client",
    "serial",
    "serial_asyncio",
    "uvloop",
}


def test_the_client_loads_nothing_of_the_daemon(tmp_path: Path) -> None:
    program = f"import sys, {', '.join(MODULES)}; print(*sys.modules, sep='\\n')"
    loaded = subprocess.run(  # noqa: S603 - our own program
        [sys.executable, "-c", program], check=True, capture_output=True, text=True, cwd=tmp_path, timeout=60
    ).stdout.split()

    assert set(MODULES) <= set(loaded)
    assert not {f"ldcnd.{name}" for name in OURS} & set(loaded)
    assert not OTHERS & set(loaded)
