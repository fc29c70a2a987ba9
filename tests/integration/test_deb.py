"""The Debian package and the guide that says how to install it."""

import hashlib
import json
import re
import shutil
import subprocess
import sysconfig
from pathlib import Path
from typing import Any

import pytest

from tests.support.booted_machine import Machine, booted_machine, eventually, why_no_machine
from tests.support.package import ROOT, build, package, snapshot, why_no_package
from tests.support.pages import broken_links

DEPLOY = ROOT / "deploy"
EXPOSURE_LIMIT = "15"
"""In tenths, as `--threshold` takes it."""
UNCOMPRESSED = "uses-no-compression-for-data-tarball,uses-no-compression-for-control-tarball"
OURS = (
    "./opt/ldcnd/",
    "./etc/ldcnd/",
    "./usr/bin/ldcnd",
    "./usr/share/doc/ldcnd/",
    "./usr/share/man/man1/ldcnd",
    "./usr/lib/",
    "./usr/share/bash-completion/completions/ldcnd",
    "./usr/share/zsh/vendor-completions/_ldcnd",
    "./usr/share/fish/vendor_completions.d/ldcnd.fish",
    "./usr/share/lintian/overrides/ldcnd",
)
PAGE = re.compile(r"docs/[\w/-]+\.md")
WANTED = {"tune": "numpy", "epics": "caproto"}
DRIVES = ("/usr/bin/ldcnd", "sim", "--pty", "/run/drives/port", "--chain", "ls-182ap,ls-182ap")
AXIS = """
[[bus.axis]]
name = "{}"
address = {}
model = "ls-182ap"
unit = "mm"
counts_per_unit = 1000
velocity = 20
acceleration = 200
limits = {{ position_min = -100, position_max = 100, velocity = 50, acceleration = 1000 }}
gains = {{ kp = 350, kd = 3000, ki = 400, il = 400, ol = 250, el = 4000 }}
"""
RIG = """
rig = "cell"
state_dir = "/var/lib/ldcnd"
[zenoh]
listen = ["tcp/127.0.0.1:7447"]
[[bus]]
name = "line0"
port = "/run/drives/port"
baud = 115200
margin_ms = 50
start = "adopt"
adopt_fallback = "reset"
"""
RIG += AXIS.format("x", 1) + AXIS.format("y", 2)
COMMANDS = re.compile(r"(?ms)^```sh\n(.*?)^```$")

pytestmark = [pytest.mark.system, pytest.mark.real_time, pytest.mark.timeout(400)]  # the first builds the packages
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
        "./usr/lib/systemd/system/ldcnd-console@.service",
        "./usr/lib/systemd/system/ldcnd-metrics@.service",
        "./usr/lib/systemd/system/ldcnd-record@.service",
        "./usr/share/bash-completion/completions/ldcnd",
        "./usr/share/doc/ldcnd/changelog.gz",
        "./usr/lib/udev/rules.d/71-ldcnd.rules",
        "./usr/lib/sysusers.d/ldcnd.conf",
        "./usr/lib/modules-load.d/ldcnd.conf",
        "./usr/share/doc/ldcnd/INSTALL.md",
        *(f"./usr/share/doc/ldcnd/{page}" for page in PAGE.findall((DEPLOY / "INSTALL.md").read_text())),
        "./usr/share/doc/ldcnd/copyright",
        f"./usr/lib/{sysconfig.get_config_var('MULTIARCH')}/wireshark/plugins/ldcnd.lua",
        "./usr/share/doc/ldcnd/examples/simulated.toml",
        "./usr/share/doc/ldcnd/examples/zenoh/local/daemon.json5",
        "./usr/share/doc/ldcnd/examples/zenoh/segment/users.txt",
        "./usr/share/doc/ldcnd/sbom.cdx.json",
        "./usr/share/man/man1/ldcnd.1.gz",
        "./usr/share/man/man1/ldcnd-axis.1.gz",
    } <= set(files)
    assert [path for path in files if path.startswith("./etc/")] == ["./etc/ldcnd/ldcnd.env"]  # no configuration


@packaged
def test_every_link_of_a_page_that_a_package_ships_leads_somewhere(deb: Path, tmp_path: Path):
    for each in deb.parent.glob("*.deb"):
        told("dpkg-deb", "--extract", str(each), str(tmp_path))
    pages = sorted((tmp_path / "usr/share/doc").rglob("*.md"))

    assert len(pages) > 60
    assert broken_links(pages) == []


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
    assert {part["name"].replace("-", "_").lower() for part in parts} == {
        *(name.lower() for name in installed),
        *("htm", "uplot", "@msgpack/msgpack"),  # scripts of the console
    }
    compiled = (tmp_path / "opt/ldcnd/lib").rglob("ldcnd/__pycache__/errors.*.pyc")
    assert all(str(tmp_path) not in code.read_bytes().decode("latin-1") for code in compiled)


@packaged
@pytest.mark.parametrize(("words", "remedy"), [("tune", "ldcnd-tuning"), ("epics", "ldcnd-bridges")])
def test_hint_for_a_missing_part_names_the_package_that_has_it(deb: Path, tmp_path: Path, words: str, remedy: str):
    told("dpkg-deb", "--extract", str(deb), str(tmp_path))
    asked = f"from ldcnd.parts import EXTRAS, missing; print(missing({WANTED[words]!r}).remedy)"

    assert f"apt install {remedy}" in told(str(tmp_path / "opt/ldcnd/bin/python"), "-c", asked)


@packaged
def test_same_source_gives_the_same_package(deb: Path, tmp_path: Path):
    again = build(snapshot(deb.parent.parent), tmp_path).parent

    digests = [
        {each.name: hashlib.sha256(each.read_bytes()).hexdigest() for each in place.glob("*.deb")}
        for place in (deb.parent, again)
    ]
    assert digests[0] == digests[1]
    assert len(digests[0]) == 3


@booted
@pytest.mark.timeout(180)
def test_every_command_of_the_guide_works(deb: Path):
    commands = COMMANDS.findall((DEPLOY / "INSTALL.md").read_text(encoding="utf-8"))
    assert len(commands) >= 8

    with booted_machine() as machine:
        machine.must("ip", "link", "set", "lo", "up")
        for each in deb.parent.glob("*.deb"):
            (machine.root / "root" / each.name).write_bytes(each.read_bytes())
        for command in commands:
            machine.must("sh", "-euxc", f"umask 022\ncd /root\n{command}", timeout_s=40)
            if "pages.pem" in command:
                require_pages_over_https(machine)
            if "ldcnd list --config site/monitor.json5" in command:
                require_helpers_to_serve(machine)

        left = machine.run("find", "/etc/systemd/system", "-name", "ldcnd*@*.service").stdout
        assert left.split() == []
        assert machine.run("ldcnd", "--version").returncode != 0
        assert (machine.root / "etc/ldcnd/ldcnd.toml").exists()


def require_pages_over_https(machine: Machine) -> None:
    """Check that the console serves under its name to who trusts its certificate, and lets in whom its link names."""
    machine.until_shown("ldcnd-console@ldcnd", "StatusText", lambda text: text.startswith("console on https://"))
    asked = """
import socket, ssl
trusting = ssl.create_default_context(cafile="/etc/ldcnd/pages.pem")
token = open("/etc/ldcnd/token").read().strip()
for path in ("/", f"/?link={token}"):
    with trusting.wrap_socket(socket.create_connection(("127.0.0.1", 8470)), server_hostname="bench.example") as link:
        link.sendall(f"GET {path} HTTP/1.1\\r\\nHost: bench.example:8470\\r\\nConnection: close\\r\\n\\r\\n".encode())
        print(link.recv(4096).split()[1].decode())
"""
    refused, let_in = machine.must("/opt/ldcnd/bin/python", "-c", asked).split()
    assert (refused, let_in) == ("401", "303")


def require_helpers_to_serve(machine: Machine) -> None:
    """Check that what is beside the daemon of a secured rig reaches it."""
    for name, serves in (("console", "console on"), ("record", "recording rig sim"), ("metrics", "metrics on")):
        unit = f"ldcnd-{name}@ldcnd"
        machine.until_shown(unit, "StatusText", lambda text, serves=serves: text.startswith(serves))  # type: ignore[misc]
        assert machine.show(unit, "ActiveState") == "active"
    scrape = "from urllib.request import *; print(urlopen('http://127.0.0.1:9464/metrics', timeout=5).read().decode())"
    eventually(
        lambda: machine.run("/opt/ldcnd/bin/python", "-c", scrape).stdout,
        lambda text: 'ldcnd_daemon_up{rig="sim"} 1.0' in text,
        20.0,
    )


@booted
def test_upgrade_leaves_what_moves_alone_and_keeps_references(deb: Path, tmp_path: Path):
    newer = repacked(deb, tmp_path, "9.9")
    with booted_machine() as machine:
        for each in (deb, newer):
            (machine.root / "root" / each.name).write_bytes(each.read_bytes())
        machine.must("ip", "link", "set", "lo", "up")
        machine.must("dpkg", "-i", f"/root/{deb.name}")
        machine.must("systemd-run", "--unit=drives", "--uid=ldcnd", "-p", "RuntimeDirectory=drives", *DRIVES)
        machine.write("/etc/ldcnd/ldcnd.toml", RIG)
        machine.must("systemctl", "start", "ldcnd")
        machine.until_shown("ldcnd", "StatusText", lambda text: "2/2 axes up" in text)
        for axis in ("x", "y"):
            machine.must("ldcnd", "power", "on", axis)
            machine.must("ldcnd", "axis", "set-position", axis, "0")
            machine.must("ldcnd", "move", axis, "3", "--wait")
        machine.must("ldcnd", "move", "x", "60", "--velocity", "2")

        machine.must("dpkg", "-i", f"/root/{newer.name}", timeout_s=60)

        assert seen(machine, "x")["moving"] == "yes"
        machine.must("systemctl", "restart", "ldcnd")
        machine.until_shown("ldcnd", "StatusText", lambda text: "2/2 axes up" in text)
        assert "9.9" in machine.must("ldcnd", "--version")
        first = [seen(machine, axis) for axis in ("x", "y")]
        machine.must("ldcnd", "move", "y", "4", "--wait")
        again = seen(machine, "x")
        assert [axis["referenced"] for axis in first] == [True, True]
        assert first[1]["position"] == pytest.approx(3, abs=0.003)
        assert 3 < first[0]["position"] < 60
        assert again["position"] == pytest.approx(first[0]["position"], abs=0.003)  # stopped on its way, and stands
        assert again["moving"] == "no"
        machine.must("ldcnd", "move", "x", "3", "--wait")  # an absolute move: what the drive counts is still true

        machine.must("dpkg", "-i", f"/root/{deb.name}", timeout_s=60)  # and back
        machine.must("systemctl", "restart", "ldcnd")
        machine.until_shown("ldcnd", "StatusText", lambda text: "2/2 axes up" in text)
        assert [seen(machine, axis)["referenced"] for axis in ("x", "y")] == [True, True]


def repacked(deb: Path, place: Path, version: str) -> Path:
    """Return the same package as another version of it."""
    root, newer = place / "again", place / f"ldcnd_{version}.deb"
    told("dpkg-deb", "--raw-extract", str(deb), str(root))
    [metadata] = root.glob("opt/ldcnd/lib/python*/site-packages/ldcnd-*.dist-info/METADATA")
    for file in (root / "DEBIAN/control", metadata):
        file.write_text(re.sub("(?m)^Version: .*", f"Version: {version}", file.read_text()), encoding="utf-8")
    told("dpkg-deb", "--root-owner-group", "-Znone", "--build", str(root), str(newer))
    return newer


def seen(machine: Machine, axis: str) -> dict[str, Any]:
    """Return an axis as `ldcnd list` shows it."""
    rows = [json.loads(line) for line in machine.must("ldcnd", "list", "--json").splitlines()]
    return next(row for row in rows if row["axis"] == axis)


@packaged
@pytest.mark.skipif(not shutil.which("lintian"), reason="no lintian")
def test_lintian_finds_no_error(deb: Path):
    for each in sorted(deb.parent.glob("*.deb")):
        done = subprocess.run(  # noqa: S603
            ["lintian", "--allow-root", "--suppress-tags", UNCOMPRESSED, str(each)],  # noqa: S607
            capture_output=True,
            text=True,
            timeout=280,
            check=False,
        )
        assert done.returncode == 0, done.stdout


@packaged
@pytest.mark.parametrize("drop_ins", [(), ("realtime", "lan", "heartbeat-gpio", "heartbeat-file")])
def test_services_are_hardly_exposed(deb: Path, tmp_path: Path, drop_ins: tuple[str, ...]):
    for each in deb.parent.glob("*.deb"):
        told("dpkg-deb", "--extract", str(each), str(tmp_path))
    units = sorted((tmp_path / "usr/lib/systemd/system").glob("ldcnd*.service"))
    more = "".join((DEPLOY / f"drop-ins/{name}.conf").read_text(encoding="utf-8") for name in drop_ins)

    for unit in units:
        unit.write_text(unit.read_text(encoding="utf-8") + more, encoding="utf-8")
        done = subprocess.run(  # noqa: S603
            ["systemd-analyze", "security", "--offline=yes", f"--threshold={EXPOSURE_LIMIT}", str(unit)],  # noqa: S607
            capture_output=True,
            text=True,
            timeout=20,
            check=False,
        )
        assert done.returncode == 0, done.stdout.splitlines()[-1]

    assert len(units) == 7
