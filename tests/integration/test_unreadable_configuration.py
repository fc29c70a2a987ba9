"""A configuration that this user may not read ends a program as one that cannot work: a service is not tried again."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.support.process import LDCND, ROOT, free_port

pytestmark = [pytest.mark.system, pytest.mark.real_time]
NO_ROOT = ("setpriv", "--bounding-set=-dac_override,-dac_read_search")
"""Root without the right to read everything, as every other user is."""
LISTEN = "127.0.0.1:0"
PROGRAMS = {
    "run": "run --config rig.toml",
    "check-config": "check-config rig.toml",
    "plan": "plan rig.toml",
    "list": "list --config rig.toml",
    "list with a login": "list --config login.json5",
    "metrics": "metrics --config login.json5",
    "record": "record --config rig.toml --out run.mcap",
    "console": f"console --listen {LISTEN} --config rig.toml",
    "console with a login": f"console --listen {LISTEN} --config login.json5",
    "console with a token": f"console --listen {LISTEN} --token-file token",
    "console with a certificate": f"console --listen {LISTEN} --certificate cert.pem --key cert.pem",
    "sequence": "sequence run rig.toml --list",
    "position": "position go rig.toml --list",
    "commission": "commission x --config rig.toml --list",
    "commission with a login": "commission x --config good.toml --login login.json5",
    "doctor": "doctor --config rig.toml --bus line0",
    "twin": "twin rig.toml",
    "simulated faults": "sim --pty port --chain ls-182ap --fault-plan rig.toml",
}


@pytest.mark.skipif(not shutil.which("setpriv"), reason="no setpriv")
@pytest.mark.skipif(os.geteuid() != 0, reason="takes the right to read everything away from root")
@pytest.mark.parametrize("program", PROGRAMS.values(), ids=PROGRAMS)
def test_what_cannot_be_read_is_named_and_ends_with_78(program: str, tmp_path: Path) -> None:
    simulated = (ROOT / "config" / "simulated.toml").read_text(encoding="utf-8")
    (tmp_path / "good.toml").write_text(simulated.replace("7447", str(free_port())), encoding="utf-8")
    unreadable = [name for name in ("rig.toml", "login.json5", "token", "cert.pem") if name in program]
    for name in unreadable:
        (tmp_path / name).write_text(simulated, encoding="utf-8")
        (tmp_path / name).chmod(0)

    done = subprocess.run(  # noqa: S603 - our own program
        [*NO_ROOT, *LDCND, *program.split()],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=60,
        stdin=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        check=False,
    )

    assert unreadable[0] in done.stderr
    assert "Traceback" not in done.stderr
    assert done.returncode == 78, done.stderr
