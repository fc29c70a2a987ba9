"""A certificate that ends: who runs a plant learns of it before, by every face, and afterwards what is the matter."""

import contextlib
import datetime as dt
import json
import socket
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from ldcnd.contract.commands import Role
from ldcnd.ops.pki.site import Site, new_login, set_up
from tests.support.process import LDCND, free_port
from tests.support.secured_rig import SecuredRig, serving

pytestmark = pytest.mark.real_time

DAY = dt.timedelta(days=1)
RENEW = "ldcnd pki renew SITE bench"
WAIT_S = 60.0


def site_with_daemon(folder: Path, lasts: dt.timedelta) -> Site:
    """Set up a site whose daemon has a certificate that ends so soon from now, and an operator who has time."""
    now = dt.datetime.now(dt.UTC)
    site = set_up(folder, "plant", now - DAY)
    days = lasts.days + 1
    site.add(new_login("bench", Role.DAEMON, ("127.0.0.1",)), now + lasts - days * DAY, days)
    site.add(new_login("operator", Role.OPERATOR, ()), now, 400)
    return site


def ldcnd(*words: object) -> subprocess.CompletedProcess[str]:
    """Run a command as people do."""
    return subprocess.run([*LDCND, *map(str, words)], capture_output=True, text=True, timeout=WAIT_S, check=False)  # noqa: S603


@contextlib.contextmanager
def service_manager(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """Listen where a service manager would, for the programs that are started meanwhile."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as door:
        door.bind(str(folder / "notify"))
        door.settimeout(WAIT_S)
        monkeypatch.setenv("NOTIFY_SOCKET", str(folder / "notify"))
        yield door
        monkeypatch.delenv("NOTIFY_SOCKET")


def status_with(door: socket.socket, words: str) -> str:
    """Return the first status with these words."""
    while True:
        told = door.recv(4096).decode()
        if words in told:
            return told


def test_each_face_tells_of_a_certificate_that_ends_soon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    site_with_daemon(tmp_path, 5 * DAY)
    rig = SecuredRig(tmp_path, f"tls/127.0.0.1:{free_port()}")

    with (
        service_manager(tmp_path, monkeypatch) as door,
        serving(tmp_path / "bench.json5", [rig.endpoint], rig.config("operator")),
    ):
        at = ("--config", tmp_path / "operator.json5", "-e", rig.endpoint)
        listed = ldcnd("list", *at)
        fleet = ldcnd("fleet", *at)
        top = ldcnd("top", *at)
        health = json.loads(ldcnd("fleet", "--json", *at).stdout)
        told = status_with(door, "READY=1")
    journal = (tmp_path / "daemon.log").read_text()
    checked = ldcnd("check-config", tmp_path / "rig.toml")

    end = (dt.datetime.now(dt.UTC) + 5 * DAY).strftime("%Y-%m-%d")
    for face in (listed.stderr, fleet.stdout, top.stdout, told, journal, checked.stderr):
        assert f"the certificate of bench ends on {end}" in face, face
        assert RENEW in face
    assert health["health"]["certificate"]["name"] == "bench"
    assert checked.returncode == 0
    assert [
        RENEW in each for each in json.loads(ldcnd("check-config", "--json", tmp_path / "rig.toml").stdout)["warnings"]
    ] == [True]


@pytest.mark.long
def test_a_daemon_tells_that_its_certificate_has_ended_while_it_ran(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    site_with_daemon(tmp_path, dt.timedelta(seconds=15))
    rig = SecuredRig(tmp_path, f"tls/127.0.0.1:{free_port()}")

    with (
        service_manager(tmp_path, monkeypatch) as door,
        serving(tmp_path / "bench.json5", [rig.endpoint], rig.config("operator")),
    ):
        told = status_with(door, "the certificate of bench has ended")
        for _ in range(5):  # in the second of its end one side may take it still, and the other one not any more
            refused = ldcnd("list", "--config", tmp_path / "operator.json5", "-e", rig.endpoint)
            if "no daemon answers" not in refused.stderr:
                break
    assert RENEW in told
    assert "the certificate of bench has ended" in (tmp_path / "daemon.log").read_text()
    assert "renew" in refused.stderr


def test_a_renewed_certificate_is_quiet_from_the_restart_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    site_with_daemon(tmp_path, 5 * DAY)
    rig = SecuredRig(tmp_path, f"tls/127.0.0.1:{free_port()}")
    at = ("--config", tmp_path / "operator.json5", "-e", rig.endpoint)

    with serving(tmp_path / "bench.json5", [rig.endpoint], rig.config("operator")):
        assert "restart what uses it" in ldcnd("pki", "renew", tmp_path, "bench").stdout
        assert RENEW in ldcnd("list", *at).stderr  # the one in use is still the old one
        assert "warning" not in ldcnd("check-config", tmp_path / "rig.toml").stderr
    with serving(tmp_path / "bench.json5", [rig.endpoint], rig.config("operator")):
        assert not ldcnd("list", *at).stderr
    assert "certificate" not in (tmp_path / "daemon.log").read_text()


def test_a_program_tells_of_its_own_login(tmp_path: Path) -> None:
    site = site_with_daemon(tmp_path, 400 * DAY)
    site.add(new_login("vic", Role.VIEWER, ()), dt.datetime.now(dt.UTC), 3)
    rig = SecuredRig(tmp_path, f"tls/127.0.0.1:{free_port()}")

    with serving(tmp_path / "bench.json5", [rig.endpoint], rig.config("operator")):
        listed = ldcnd("list", "--json", "--config", tmp_path / "vic.json5", "-e", rig.endpoint)
    assert "the certificate of vic ends on" in listed.stderr
    assert [json.loads(line) for line in listed.stdout.splitlines()]
    assert "certificate of bench" not in listed.stdout + listed.stderr


def test_a_site_lists_until_when_its_certificates_are_good(tmp_path: Path) -> None:
    site = site_with_daemon(tmp_path, 5 * DAY)
    site.add(new_login("gone", Role.VIEWER, ()), dt.datetime.now(dt.UTC), 5)
    site.revoke("gone")

    text = ldcnd("pki", "list", tmp_path).stdout
    lines = [json.loads(line) for line in ldcnd("pki", "list", "--json", tmp_path).stdout.splitlines()]

    assert [(line["name"], line["role"]) for line in lines] == [
        ("plant", "authority"),
        ("bench", "daemon"),
        ("operator", "operator"),
    ]
    assert [bool(line["problem"]) for line in lines] == [False, True, False]
    assert "within 5 days" in next(line for line in text.splitlines() if line.startswith("bench"))


def test_a_console_tells_of_the_certificate_of_its_pages(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    site_with_daemon(tmp_path, 2 * DAY)
    (tmp_path / "token").write_text("0123456789" * 4)
    (tmp_path / "token").chmod(0o600)
    words = ["--listen", "127.0.0.1:0", "--token-file", tmp_path / "token", "-e", f"tcp/127.0.0.1:{free_port()}"]
    words += ["--certificate", tmp_path / "bench.pem", "--key", tmp_path / "bench.key"]

    with service_manager(tmp_path, monkeypatch) as door:
        console = subprocess.Popen([*LDCND, "console", *map(str, words)], stdout=subprocess.DEVNULL)  # noqa: S603
        try:
            assert "restart the console" in status_with(door, "the certificate of bench ends on")
        finally:
            console.terminate()
            console.wait(WAIT_S)
