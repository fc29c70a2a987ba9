"""The serial ports of this machine: what `ldcnd scan` lists, who has one, and what a pattern means."""

import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from ldcnd.contract.errors import ConfigError, TransportLost
from ldcnd.drives.ldcn.config import LdcnBusConfig
from ldcnd.line import ports_here as here
from ldcnd.line.port_url import check_port, port_opener
from tests.support.command_line import run_here

HOLDS = """
import serial, sys
port = serial.Serial(sys.argv[1], exclusive=True)
print("open", flush=True)
sys.stdin.read()
"""


@pytest.fixture
def terminals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """Make two pseudo-terminals, which pyserial takes for adapters; returns their devices."""
    pairs = [os.openpty() for _ in range(2)]
    devices = [os.ttyname(far) for _, far in pairs]
    listed = [
        SimpleNamespace(device=device, description=what, hwid=f"USB VID:PID=0403:6001 SER={number}", name="")
        for device, what, number in zip(devices, ("FT232R USB UART", "n/a"), ("FT4ABCDE", "FT4XYZ"), strict=True)
    ]
    monkeypatch.setattr(
        "serial.tools.list_ports.grep",
        lambda pattern: (each for each in listed if pattern.lower() in f"{each.hwid} {each.device}.".lower()),
    )
    yield devices
    for each in (end for pair in pairs for end in pair):
        os.close(each)


def test_ports_are_listed_with_adapter_and_holder(terminals: list[str]):
    with subprocess.Popen(  # noqa: S603
        [sys.executable, "-c", HOLDS, terminals[0]], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as holder:
        assert holder.stdout
        assert holder.stdout.readline() == "open\n"
        shown = run_here("scan", "--json")
        in_words = run_here("scan")
        holder.communicate()

    rows = {row["port"]: row for row in map(json.loads, shown.printed.splitlines())}
    assert shown.code == 0
    assert set(rows) == set(terminals)
    assert rows[terminals[0]]["adapter"] == "FT232R USB UART"
    assert any(each.endswith(f"({holder.pid})") for each in rows[terminals[0]]["held_by"])
    assert not any(each.endswith(f"({holder.pid})") for each in rows[terminals[1]]["held_by"])
    (line,) = (line for line in in_words.printed.splitlines() if line.startswith(f"{terminals[0]} "))
    assert f"({holder.pid})" in line


def test_a_machine_without_ports_says_so(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("serial.tools.list_ports.grep", lambda _: iter(()))

    listed = run_here("scan")

    assert (listed.code, listed.printed) == (1, "")
    assert "no serial port" in listed.errors


def test_what_belongs_to_a_search_needs_a_port():
    assert run_here("scan", "--address").code == 2


def test_a_lock_of_another_user_names_its_program(tmp_path: Path):
    device = tmp_path / "port"
    device.touch()
    node, proc = device.stat(), tmp_path / "proc"
    (proc / "4711").mkdir(parents=True)
    (proc / "4711/comm").write_text("minicom\n")
    place = f"{os.major(node.st_dev):02x}:{os.minor(node.st_dev):02x}"
    locks = [
        f"1: FLOCK  ADVISORY  WRITE 4711 {place}:{node.st_ino} 0 EOF",
        f"2: FLOCK  ADVISORY  WRITE 0 {place}:{node.st_ino} 0 EOF",
        f"3: FLOCK  ADVISORY  WRITE 12 {place}:{node.st_ino + 1} 0 EOF",
    ]
    (proc / "locks").write_text("\n".join(locks))

    assert here.held_by(device, proc) == ("minicom (4711)",)
    assert here.held_by(tmp_path / "gone", proc) == ()


def test_a_pattern_means_the_one_port_that_it_fits(terminals: list[str]):
    assert here.port_matching("ft4xyz") == terminals[1]
    with pytest.raises(TransportLost, match="no port fits"):
        here.port_matching("FT4ABCDX")
    with pytest.raises(TransportLost, match="several ports fit it") as refused:
        here.port_matching("FT4")
    assert terminals[0] in refused.value.message


@pytest.mark.real_time
async def test_a_line_opens_the_port_that_its_pattern_fits(terminals: list[str]):
    port = await port_opener("hwgrep://FT4ABCDE", 19_200)()
    assert any(str(os.getpid()) in each for each in here.held_by(Path(terminals[0])))
    await port.close()
    with pytest.raises(TransportLost, match="no port fits"):
        await port_opener("hwgrep://FT9", 19_200)()


@pytest.mark.parametrize("port", ["hwgrep://FT4ABCDE", "rfc2217://server:4001", "socket://[::1]:4001", "/dev/ttyUSB0"])
def test_a_configuration_takes_every_kind_of_port(port: str):
    axis = {"name": "x", "address": 1, "model": "ls-182ap", "unit": "count", "velocity": 1, "acceleration": 1}
    line = {"name": "line0", "family": "ldcn", "axis": [axis]}

    assert LdcnBusConfig.model_validate(line | {"port": port}).port == port
    with pytest.raises(ValueError, match="is not a device path"):
        LdcnBusConfig.model_validate(line | {"port": port.removeprefix("/").replace("://", "//")})


def test_a_relative_path_is_refused_with_the_whole_one():
    with pytest.raises(ConfigError, match="is not a device path") as refused:
        check_port("./line0")
    assert f"{Path.cwd()}/line0" in str(refused.value.remedy)
