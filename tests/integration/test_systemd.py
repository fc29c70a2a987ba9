"""The installed service under a real systemd."""

import json
import re
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from tests.support.booted_machine import Machine, booted_machine, eventually, why_no_machine
from tests.support.package import package, why_no_package

why_not = why_no_machine() or why_no_package()
pytestmark = [
    pytest.mark.system,
    pytest.mark.real_time,
    pytest.mark.skipif(why_not is not None, reason=why_not or ""),
]

UNIT = "ldcnd.service"
CONFIG = "/etc/ldcnd/ldcnd.toml"
SIMULATED = (Path(__file__).parents[2] / "config" / "simulated.toml").read_text(encoding="utf-8")
DEPLOY = Path(__file__).parents[2] / "deploy"
LINK = re.compile(r"http://127\.0\.0\.1:8470/\S+")
RECORDINGS = "/var/lib/ldcnd-record/ldcnd"
METRICS = "http://127.0.0.1:9464/metrics"
DROP_INS = "/etc/systemd/system/ldcnd.service.d"
FAST_WATCHDOG = "[Service]\nWatchdogSec=2\nStartLimitBurst=100\n"

PROBE = """
import errno, json, os, socket
def attempt(action):
    try:
        action()
    except OSError as error:
        return errno.errorcode[error.errno]
    return "done"
def opening(path):
    return lambda: os.close(os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_NOCTTY))
def sending(address):
    return lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM).sendto(b"x", (address, 9))
print(json.dumps({
    "serial": attempt(opening("/dev/ldcnd-test-serial")),
    "other": attempt(opening("/dev/ldcnd-test-other")),
    "kernel": attempt(opening("/sys/class/mem/ldcnd-test-led")),
    "here": attempt(sending("127.0.0.1")),
    "elsewhere": attempt(sending("198.18.0.2")),
    "etc": attempt(lambda: open("/etc/ldcnd/written", "w")),
    "state": attempt(lambda: open(os.environ.get("STATE_DIRECTORY", "/var/lib") + "/written", "w")),
}))
"""


@pytest.fixture(scope="module")
def machine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machine]:
    deb = package(tmp_path_factory)
    with booted_machine() as machine:
        (machine.root / "root" / deb.name).write_bytes(deb.read_bytes())
        machine.must("dpkg", "-i", f"/root/{deb.name}")
        machine.must("ip", "link", "set", "lo", "up")
        machine.must("ip", "address", "add", "198.18.0.1/24", "dev", "lo")
        yield machine


@pytest.fixture
def service(machine: Machine) -> Iterator[Machine]:
    """Return the machine with the service running on the simulated rig, all axes up."""
    machine.write(CONFIG, SIMULATED)
    machine.write(f"{DROP_INS}/test.conf", FAST_WATCHDOG)
    machine.must("systemctl", "daemon-reload")
    machine.must("systemctl", "start", UNIT)
    machine.until_shown(UNIT, "StatusText", lambda text: "1/1 buses, 4/4 axes up" in text)
    yield machine
    machine.must("systemctl", "stop", UNIT)
    machine.run("systemctl", "reset-failed", UNIT)
    machine.must("rm", "-r", DROP_INS)


def fetched(machine: Machine, url: str) -> str:
    """Return what is served there; nothing while nothing is."""
    opened = (
        f"build_opener(HTTPCookieProcessor()).open({url!r}, timeout=5)"  # as a browser, which keeps what it is given
    )
    asked = f"from urllib.request import *; print({opened}.read().decode())"
    return machine.run("/opt/ldcnd/bin/python", "-c", asked).stdout


def log_of(machine: Machine, unit: str = UNIT) -> str:
    machine.must("journalctl", "--sync")
    return machine.must("journalctl", "--no-pager", "--output=cat", "--unit", unit)


def test_service_is_active_and_says_what_works(service: Machine):
    assert service.show(UNIT, "ActiveState") == "active"
    assert service.show(UNIT, "StatusText") == "rig sim: 1/1 buses, 4/4 axes up"
    listed = service.must("ldcnd", "list", "--json").splitlines()
    assert [axis["axis"] for axis in map(json.loads, listed)] == ["x", "y", "z", "c"]


def test_reload_applies_what_it_can_and_names_the_rest(service: Machine):
    pid = service.show(UNIT, "MainPID")
    service.write(CONFIG, SIMULATED.replace("velocity = 50", "velocity = 45").replace("address = 4", "address = 5"))

    service.must("systemctl", "reload", UNIT)

    status = service.until_shown(UNIT, "StatusText", lambda text: "restart" in text)
    assert status.endswith("restart needed for bus.line0.axis.c.address")
    assert "bus.line0.axis.x.limits.velocity" in log_of(service)
    assert (service.show(UNIT, "ActiveState"), service.show(UNIT, "MainPID")) == ("active", pid)
    service.must("ldcnd", "power", "on", "x")
    refused = service.run("ldcnd", "move", "x", "1", "--velocity", "48")
    assert "45" in refused.stderr


def test_reload_of_a_wrong_file_fails_and_the_daemon_runs_on(service: Machine):
    service.write(CONFIG, SIMULATED.replace("baud = 115200", "baud = 1"))
    pid = service.show(UNIT, "MainPID")

    done = service.run("systemctl", "reload", UNIT)

    assert service.show(UNIT, "MainPID") == pid
    assert service.show(UNIT, "ActiveState") == "active"
    if "ExecReload" in service.must("systemctl", "cat", UNIT):
        assert done.returncode != 0
    else:
        assert "not reloaded" in service.show(UNIT, "StatusText")


def test_wrong_configuration_is_not_tried_again(machine: Machine):
    machine.write(CONFIG, "rig = 1\n")

    machine.run("systemctl", "start", UNIT)

    machine.until_shown(UNIT, "ActiveState", lambda state: state == "failed")
    assert machine.show(UNIT, "ExecMainStatus") == "78"
    assert machine.show(UNIT, "NRestarts") == "0"
    machine.must("systemctl", "reset-failed", UNIT)


def test_daemon_that_hangs_is_killed_and_started_again(service: Machine):
    before = int(service.show(UNIT, "NRestarts"))
    pid = service.show(UNIT, "MainPID")

    service.must("kill", "-STOP", pid)

    service.until_shown(UNIT, "NRestarts", lambda restarts: int(restarts) == before + 1)
    service.until_shown(UNIT, "StatusText", lambda text: "4/4 axes up" in text)
    assert service.show(UNIT, "MainPID") != pid
    assert "Watchdog timeout" in log_of(service)


def test_restarts_by_hand_are_never_too_many(machine: Machine):
    machine.write(CONFIG, SIMULATED)
    machine.must("systemctl", "start", UNIT)
    for _ in range(8):  # each of them as fast as it goes
        machine.must("systemctl", "restart", UNIT)

    assert machine.show(UNIT, "ActiveState") == "active"
    machine.must("systemctl", "stop", UNIT)


def test_a_daemon_that_fails_again_and_again_stays_down(machine: Machine):
    machine.write(f"{DROP_INS}/test.conf", "[Service]\nExecStart=\nExecStart=/bin/false\n")
    machine.must("systemctl", "daemon-reload")
    machine.run("systemctl", "start", UNIT)
    machine.until_shown(UNIT, "NRestarts", lambda count: count == "19", within_s=120.0)
    machine.until_shown(UNIT, "ActiveState", lambda state: state == "failed", within_s=30.0)
    refused = machine.run("systemctl", "start", UNIT)
    machine.must("rm", "-r", DROP_INS)
    machine.must("systemctl", "daemon-reload")
    machine.write(CONFIG, SIMULATED)
    machine.must("systemctl", "reset-failed", UNIT)
    machine.must("systemctl", "start", UNIT)
    machine.must("systemctl", "stop", UNIT)

    assert refused.returncode != 0
    assert "too quickly" in machine.must("journalctl", "-u", UNIT)


def test_stop_brings_what_moves_to_rest_in_time(service: Machine):
    service.must("ldcnd", "power", "on", "x")
    service.must("ldcnd", "move", "x", "90", "--velocity", "5")

    service.must("systemctl", "stop", UNIT, timeout_s=12)

    assert service.show(UNIT, "Result") == "success"
    log = log_of(service).split("loss policy")[-1]
    assert "axis=x" in log
    assert "not everything came to rest" not in log
    assert "ended" in log


def test_journal_has_priorities_and_no_decoration(service: Machine):
    entries = service.must("journalctl", "--no-pager", "--output=json", "--unit", UNIT)
    up = [entry for entry in map(json.loads, entries.splitlines()) if str(entry["MESSAGE"]).startswith("line up")]

    assert up
    assert {entry["PRIORITY"] for entry in up} == {"6"}
    assert "bus=line0" in up[-1]["MESSAGE"]


@pytest.mark.skipif(find_spec("logging_journald") is None, reason="no logging_journald")
def test_journal_entries_can_be_found_by_their_fields(service: Machine):
    spec = find_spec("logging_journald")
    assert spec
    assert spec.origin
    (packages,) = (service.root / "opt/ldcnd/lib").glob("python3.*/site-packages")
    (packages / "logging_journald.py").write_bytes(Path(spec.origin).read_bytes())
    service.must("systemctl", "restart", UNIT)
    service.until_shown(UNIT, "StatusText", lambda text: "4/4 axes up" in text)

    service.must("ldcnd", "power", "on", "x")
    service.must("journalctl", "--sync")

    found = service.must("journalctl", "--no-pager", "--output=json", "EXTRA_AXIS=x", "EXTRA_VERB=power")
    (packages / "logging_journald.py").unlink()
    entries = [json.loads(line) for line in found.splitlines()]
    entry = next(entry for entry in entries if entry["MESSAGE"].startswith("command axis=x command_id="))
    assert entry["EXTRA_COMMAND_ID"]
    assert (entry["PRIORITY"], entry["SYSLOG_IDENTIFIER"], entry["_SYSTEMD_UNIT"]) == ("6", "ldcnd", UNIT)


def test_two_rigs_run_beside_each_other(service: Machine):
    service.write("/etc/ldcnd/cell.toml", SIMULATED.replace('rig = "sim"', 'rig = "cell"').replace("7447", "7448"))

    service.must("systemctl", "start", "ldcnd@cell")

    service.until_shown("ldcnd@cell", "StatusText", lambda text: text == "rig cell: 1/1 buses, 4/4 axes up")
    assert service.show(UNIT, "StatusText") == "rig sim: 1/1 buses, 4/4 axes up"
    service.must("systemctl", "stop", "ldcnd@cell")


def test_rig_of_several_may_write_to_its_own_place_only(service: Machine):
    beside = SIMULATED.replace('rig = "sim"', 'rig = "cell"\nstate_dir = "/var/lib/ldcnd"').replace("7447", "7448")
    service.write("/etc/ldcnd/cell.toml", beside)

    assert service.run("systemctl", "start", "ldcnd@cell").returncode != 0
    refused = service.show("ldcnd@cell", "ExecMainStatus")
    log = log_of(service, "ldcnd@cell")
    service.write("/etc/ldcnd/cell.toml", beside.replace("/var/lib/ldcnd", "/var/lib/ldcnd/cell"))
    service.must("systemctl", "start", "ldcnd@cell")

    assert refused == "78"
    assert 'state_dir = "/var/lib/ldcnd/cell", where the service may write' in log
    service.must("systemctl", "stop", "ldcnd@cell")


def test_the_local_set_up_starts_and_its_socket_outlives_other_rigs(service: Machine):
    local = ("/usr/share/doc/ldcnd/examples/zenoh/local/daemon.json5", "/etc/ldcnd/local.json5")
    service.must("cp", *local)
    listen = 'listen = ["tcp/127.0.0.1:7447"]'
    service.write(CONFIG, SIMULATED.replace(listen, 'config_file = "local.json5"'))
    service.write(
        "/etc/ldcnd/cell.json5", service.read(local[1]).replace("7447", "7448").replace("/ldcnd/o", "/ldcnd/cell/o")
    )
    cell = SIMULATED.replace('rig = "sim"', 'rig = "cell"').replace(listen, 'config_file = "cell.json5"')
    service.write("/etc/ldcnd/cell.toml", cell)
    sockets = {
        rig: f"unixsock-stream//run/ldcnd/{place}operator.sock" for rig, place in (("sim", ""), ("cell", "cell/"))
    }

    for unit in ("ldcnd@cell", UNIT):
        service.must("systemctl", "restart", unit)
    service.must("systemctl", "restart", "ldcnd@cell")
    service.must("systemctl", "kill", "-s", "KILL", UNIT)
    service.until_shown(UNIT, "NRestarts", lambda restarts: restarts != "0")
    for unit in ("ldcnd@cell", UNIT):
        service.until_shown(unit, "StatusText", lambda text: "4/4 axes up" in text)

    for socket in sockets.values():
        service.must("ldcnd", "power", "on", "x", "--connect", socket)
        service.must("runuser", "-u", "nobody", "-g", "ldcnd", "--", "ldcnd", "power", "off", "x", "--connect", socket)
        assert service.run("runuser", "-u", "nobody", "--", "ldcnd", "list", "--connect", socket).returncode != 0
    assert "x" in service.must("ldcnd", "list", "--connect", "tcp/127.0.0.1:7447")
    service.must("systemctl", "stop", "ldcnd@cell")


def test_a_socket_without_a_folder_is_not_tried_again(service: Machine):
    service.must("systemctl", "stop", UNIT)
    local = service.read("/usr/share/doc/ldcnd/examples/zenoh/local/daemon.json5")
    service.write("/etc/ldcnd/local.json5", local.replace("/run/ldcnd/", "/run/nowhere/"))
    service.write(CONFIG, SIMULATED.replace('listen = ["tcp/127.0.0.1:7447"]', 'config_file = "local.json5"'))

    assert service.run("systemctl", "start", UNIT).returncode != 0
    assert service.show(UNIT, "ExecMainStatus") == "78"
    assert "there is no folder /run/nowhere" in log_of(service)


def test_a_console_is_asked_for_its_link_as_soon_as_it_is_started(service: Machine):
    unit = "ldcnd-console@ldcnd"
    for _ in range(3):
        service.must("systemctl", "start", unit)
        service.must("systemctl", "kill", "-s", "USR1", unit)
        link = LINK.findall(service.must("ldcnd", "console", "--link"))[-1]
        assert "<html" in fetched(service, link)
        assert service.show(unit, "NRestarts") == "0"
        service.must("systemctl", "stop", unit)


def test_a_recorder_says_that_its_disk_is_full_leaves_nothing_and_goes_on_when_it_is_not(service: Machine):
    unit = "ldcnd-record@ldcnd"
    service.must("systemctl", "start", unit)
    service.must("systemctl", "stop", unit)
    service.must("mount", "-t", "tmpfs", "-o", "size=64k,mode=777", "full", RECORDINGS)
    try:
        service.must("dd", "if=/dev/zero", f"of={RECORDINGS}/full", "bs=1k", "count=64")
        service.run("systemctl", "start", unit)
        service.until_shown(
            unit, "StatusText", lambda text: f"No space left on device; make room in {RECORDINGS}: " in text
        )
        assert f"make room in {RECORDINGS}: " in log_of(service, unit)
        service.until_shown(unit, "NRestarts", lambda restarts: int(restarts) >= 2)
        assert service.must("ls", RECORDINGS).split() == ["full"]
        service.must("mount", "-o", "remount,size=64m", RECORDINGS)
        service.until_shown(unit, "StatusText", lambda text: text.startswith("recording rig sim"))
    finally:
        service.must("systemctl", "stop", unit)
        service.must("umount", "--lazy", RECORDINGS)


def test_a_file_that_the_service_may_not_read_is_not_tried_again(machine: Machine):
    machine.write(CONFIG, SIMULATED)
    machine.must("chmod", "600", CONFIG)
    try:
        machine.run("systemctl", "start", UNIT)
        machine.until_shown(UNIT, "ActiveState", lambda state: state == "failed")
        assert machine.show(UNIT, "ExecMainStatus") == "78"
    finally:
        machine.must("chmod", "644", CONFIG)
        machine.must("systemctl", "reset-failed", UNIT)


def test_realtime_drop_in_moves_only_the_event_loop_ahead(service: Machine):
    service.write(f"{DROP_INS}/realtime.conf", (DEPLOY / "drop-ins/realtime.conf").read_text(encoding="utf-8"))
    service.must("systemctl", "daemon-reload")

    service.must("systemctl", "restart", UNIT)

    service.until_shown(UNIT, "StatusText", lambda text: "4/4 axes up" in text)
    pid = service.show(UNIT, "MainPID")
    policies = dict(
        re.findall(r"pid (\d+)'s current scheduling policy: (\w+)", service.must("chrt", "--all-tasks", "--pid", pid))
    )
    assert policies.pop(pid) == "SCHED_FIFO"
    assert policies
    assert set(policies.values()) == {"SCHED_OTHER"}


def probed(machine: Machine, *drop_ins: str) -> dict[str, str]:
    """Let a probe run in the service's sandbox."""
    unit = machine.read(f"/usr/lib/systemd/system/{UNIT}")
    unit = re.sub(r"(?m)^(Type|WatchdogSec|ExecStart|Restart)=.*\n", "", unit)
    machine.write("/opt/ldcnd/probe.py", PROBE)
    machine.write(
        "/etc/systemd/system/ldcnd-probe.service",
        unit.replace("[Service]\n", "[Service]\nType=oneshot\nExecStart=/opt/ldcnd/bin/python /opt/ldcnd/probe.py\n"),
    )
    for number, text in enumerate(drop_ins):
        machine.write(f"/etc/systemd/system/ldcnd-probe.service.d/{number}.conf", text)
    machine.must("systemctl", "daemon-reload")
    machine.must("systemctl", "start", "ldcnd-probe")
    machine.run("rm", "-rf", "/etc/systemd/system/ldcnd-probe.service.d")
    said = log_of(machine, "ldcnd-probe").splitlines()
    found: dict[str, str] = json.loads([line for line in said if line.startswith("{")][-1])
    return found


@pytest.fixture(scope="module")
def devices(machine: Machine) -> Machine:
    """Make a serial port, another device and a file below /sys that everybody may open."""
    for name, major, minor in (("serial", "4", "64"), ("other", "1", "11")):
        machine.must("mknod", "-m", "666", f"/dev/ldcnd-test-{name}", "c", major, minor)
    machine.must("mount", "-t", "tmpfs", "-o", "mode=755", "led", "/sys/class/mem")
    machine.must("install", "-m", "666", "/dev/null", "/sys/class/mem/ldcnd-test-led")
    return machine


def test_without_the_sandbox_the_probe_is_free(devices: Machine):
    found: dict[str, str] = json.loads(devices.must("/opt/ldcnd/bin/python", "-c", PROBE))

    assert found["serial"] != "EPERM"
    assert found | {"serial": ""} == dict.fromkeys(found, "done") | {"serial": ""}


def test_sandbox_lets_through_serial_lines_this_machine_and_its_own_state(devices: Machine):
    found = probed(devices)

    assert found["serial"] not in {"EPERM", "EACCES"}
    assert found["other"] == "EPERM"
    assert found["kernel"] == "EROFS"
    assert found["here"] == "done"
    assert found["elsewhere"] == "EPERM"
    assert found["etc"] == "EROFS"
    assert found["state"] == "done"


def test_lan_drop_in_opens_the_named_subnet(devices: Machine):
    lan = (DEPLOY / "drop-ins/lan.conf").read_text(encoding="utf-8")

    found = probed(devices, re.sub(r"IPAddressAllow=.*", "IPAddressAllow=198.18.0.0/24", lan))

    assert found["elsewhere"] == "done"
    assert found["other"] == "EPERM"


@pytest.mark.parametrize(("wire", "kernel"), [("file", "done"), ("gpio", "EROFS")])
def test_heartbeat_drop_ins_open_their_wire_and_no_other_device(devices: Machine, wire: str, kernel: str):
    devices.must("groupadd", "--force", "--system", "gpio")

    found = probed(devices, (DEPLOY / f"drop-ins/heartbeat-{wire}.conf").read_text(encoding="utf-8"))

    assert (found["kernel"], found["other"], found["elsewhere"]) == (kernel, "EPERM", "EPERM")


def test_console_recording_and_metrics_run_beside_the_daemon(service: Machine):
    beside = [f"ldcnd-{name}@ldcnd.service" for name in ("console", "record", "metrics")]
    try:
        service.must("systemctl", "enable", "--now", *beside)
        eventually(lambda: fetched(service, METRICS), lambda text: 'axis="x"' in text, 20.0)
        log = eventually(lambda: log_of(service, beside[0]), lambda text: bool(LINK.search(text)), 20.0)
        assert "<html" in fetched(service, LINK.findall(log)[-1])
        eventually(lambda: service.run("ls", RECORDINGS).stdout, lambda text: ".mcap" in text, 20.0)
        pids = [service.show(unit, "MainPID") for unit in beside]

        service.must("systemctl", "restart", UNIT)
        service.until_shown(UNIT, "StatusText", lambda text: "4/4 axes up" in text)
        assert [service.show(unit, "MainPID") for unit in beside] == pids

        service.must("systemctl", "stop", *beside)
        for unit in beside:
            service.until_shown(unit, "ActiveState", lambda state: state == "inactive")
        assert all(name.endswith(".mcap") for name in service.must("ls", RECORDINGS).split())  # none cut off
        service.must("systemctl", "restart", UNIT)
        eventually(lambda: fetched(service, METRICS), lambda text: 'axis="x"' in text, 20.0)
        for unit in beside:
            service.until_shown(unit, "ActiveState", lambda state: state == "active")
    finally:
        service.run("systemctl", "disable", "--now", *beside)


@pytest.mark.parametrize("wrong", [True, False])
def test_what_is_beside_a_daemon_outlives_it_and_serves_when_it_is_back(service: Machine, wrong: bool):  # noqa: FBT001
    beside = [f"ldcnd-{name}@ldcnd.service" for name in ("console", "record", "metrics")]
    try:
        service.must("systemctl", "start", *beside)
        pids = [service.show(unit, "MainPID") for unit in beside]
        if wrong:
            service.write(CONFIG, "rig = 1\n")
            service.run("systemctl", "restart", UNIT)
            assert service.show(UNIT, "ExecMainStatus") == "78"
        else:
            service.must("systemctl", "stop", UNIT)
            assert service.show(UNIT, "StatusText") == "stopped; all axes at rest"

        for unit in beside:
            service.until_shown(unit, "StatusText", lambda text: "no daemon" in text or "cannot connect" in text)
        eventually(lambda: fetched(service, METRICS), lambda text: 'ldcnd_daemon_up{rig="sim"} 0.0' in text, 20.0)
        service.write(CONFIG, SIMULATED)
        service.must("systemctl", "restart", UNIT)
        for unit, serves in zip(beside, ("console on", "recording rig sim", "metrics on"), strict=True):
            service.until_shown(unit, "StatusText", lambda text, serves=serves: text.startswith(serves))  # type: ignore[misc]
        eventually(lambda: fetched(service, METRICS), lambda text: 'axis="x"' in text, 20.0)
        assert [service.show(unit, "MainPID") for unit in beside] == pids
    finally:
        service.write(CONFIG, SIMULATED)
        service.run("systemctl", "stop", *beside)


def test_units_are_understood_whole(machine: Machine):
    done = machine.run("systemd-analyze", "verify", "--man=no", f"/usr/lib/systemd/system/{UNIT}", "ldcnd@cell.service")

    assert "ldcnd" not in done.stderr
    assert done.returncode == 0
