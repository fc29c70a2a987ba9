"""The Debian package and the guide that says how to install it."""

import hashlib
import json
import re
import shutil
import subprocess
import sysconfig
from pathlib import Path

import pytest

from tests.support.booted_machine import booted_machine, why_no_machine
from tests.support.package import ROOT, build, package, snapshot, why_no_package

DEPLOY = ROOT / "deploy"
EXPOSURE_LIMIT = "15"
"""In tenths, as `--threshold` takes it."""
OURS = (
    "./opt/ldcnd/",
    "./etc/ldcnd/",
    "./usr/bin/ldcnd",
    "./usr/share/doc/ldcnd/",
    "./usr/share/man/man1/ldcnd",
    "./usr/lib/",
)
COMMANDS = re.compile(r"(?ms)^```sh\n(.*?)^```$")

pytestmark = [pytest.mark.system, pytest.mark.real_time]
no_package = why_no_package()
no_machine = no_package or why_no_machine()
packaged = pytest.mark.skipif(no_package is not None, reason=no_package or "")
booted = pytest.mark.skipif(no_machine is not None, reason=no_machine or "")


@pytest.fixture(scope="module")
def deb(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return package(tmp_path_factory)


def told(*command: str) -> str:
    return subprocess.run(command, capture_output=True, text=True, timeout=30, check=True).stdout  # noqa: S603


@packaged
def test_package_holds_what_the_service_needs_and_touches_nothing_else(deb: Path):
    paths = [
        line.split(maxsplit=5)[5].split(" -> ")[0] for line in told("dpkg-deb", "--contents", str(deb)).splitlines()
    ]
    files = [path for path in paths if not path.endswith("/")]

    assert not [path for path in files if not path.startswith(OURS)]
    assert {
        "./usr/lib/systemd/system/ldcnd.service",
        "./usr/lib/systemd/system/ldcnd@.service",
        "./usr/lib/udev/rules.d/71-ldcnd.rules",
        "./usr/lib/sysusers.d/ldcnd.conf",
        "./usr/lib/modules-load.d/ldcnd.conf",
        "./usr/share/doc/ldcnd/INSTALL.md",
        "./usr/share/doc/ldcnd/copyright",
        f"./usr/lib/{sysconfig.get_config_var('MULTIARCH')}/wireshark/plugins/ldcnd.lua",
        "./usr/share/doc/ldcnd/examples/simulated.toml",
        "./usr/share/doc/ldcnd/sbom.cdx.json",
        "./usr/share/man/man1/ldcnd.1.gz",
        "./usr/share/man/man1/ldcnd-axis.1.gz",
    } <= set(files)
    assert "./etc/ldcnd/" in paths  # and no configuration: nothing runs unless somebody wrote one


@packaged
def test_program_runs_wherever_the_package_is_unpacked(deb: Path, tmp_path: Path):
    told("dpkg-deb", "--extract", str(deb), str(tmp_path))

    checked = told(
        str(tmp_path / "opt/ldcnd/bin/ldcnd"),
        "check-config",
        str(tmp_path / "usr/share/doc/ldcnd/examples/simulated.toml"),
    )

    assert "axes x, y, z, c: valid" in checked
    parts = json.loads((tmp_path / "usr/share/doc/ldcnd/sbom.cdx.json").read_text())["components"]
    installed = {path.name.partition("-")[0] for path in (tmp_path / "opt/ldcnd/lib").rglob("*.dist-info")}
    assert {part["name"].replace("-", "_").lower() for part in parts} == {name.lower() for name in installed}
    compiled = (tmp_path / "opt/ldcnd/lib").rglob("ldcnd/__pycache__/errors.*.pyc")
    assert all(str(tmp_path) not in code.read_bytes().decode("latin-1") for code in compiled)


@packaged
def test_same_source_gives_the_same_package(deb: Path, tmp_path: Path):
    again = build(snapshot(deb.parent.parent), tmp_path)

    assert hashlib.sha256(again.read_bytes()).digest() == hashlib.sha256(deb.read_bytes()).digest()


@booted
@pytest.mark.timeout(180)
def test_every_command_of_the_guide_works(deb: Path):
    commands = COMMANDS.findall((DEPLOY / "INSTALL.md").read_text(encoding="utf-8"))
    assert len(commands) >= 8

    with booted_machine() as machine:
        machine.must("ip", "link", "set", "lo", "up")
        (machine.root / "root" / deb.name).write_bytes(deb.read_bytes())
        for command in commands:
            machine.must("sh", "-euxc", f"cd /root\n{command}", timeout_s=20)

        assert machine.run("ldcnd", "--version").returncode != 0
        assert (machine.root / "etc/ldcnd/ldcnd.toml").exists()


@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="no systemd-analyze")
@pytest.mark.parametrize("drop_ins", [(), ("realtime", "lan")])
def test_service_is_hardly_exposed(tmp_path: Path, drop_ins: tuple[str, ...]):
    unit = tmp_path / "ldcnd.service"
    names = ["ldcnd.service", *(f"drop-ins/{name}.conf" for name in drop_ins)]
    unit.write_text("".join((DEPLOY / name).read_text(encoding="utf-8") for name in names), encoding="utf-8")

    done = subprocess.run(  # noqa: S603
        ["systemd-analyze", "security", "--offline=yes", f"--threshold={EXPOSURE_LIMIT}", str(unit)],  # noqa: S607
        capture_output=True,
        text=True,
        timeout=20,
        check=False,
    )

    assert done.returncode == 0, done.stdout.splitlines()[-1]


def test_template_differs_only_in_what_names_the_rig():
    one, each = ((DEPLOY / name).read_text(encoding="utf-8") for name in ("ldcnd.service", "ldcnd@.service"))

    differing = [a for a, b in zip(one.splitlines(), each.splitlines(), strict=True) if a != b]

    assert [re.split("=| on ", line)[0] for line in differing] == [
        "# One rig",
        "Description",
        "ExecStart",
        "StateDirectory",
    ]
    assert each.count("%i") == one.replace(": /etc/ldcnd/ldcnd.toml", "").count("ldcnd.toml") + 2


@pytest.mark.parametrize("plain", ["systemd-252.conf"])
def test_drop_in_of_the_template_reads_the_file_of_its_rig(plain: str):
    one = (DEPLOY / "drop-ins" / plain).read_text(encoding="utf-8")

    each = (DEPLOY / "drop-ins" / plain.replace(".conf", "@.conf")).read_text(encoding="utf-8")

    assert each == one.replace("ldcnd.toml", "%i.toml")
