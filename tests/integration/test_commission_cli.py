"""`ldcnd commission` as it is typed: questions, the change of the configuration, the record, the report, exit codes."""

import json

import pytest

from ldcnd.config.rig import load_config
from ldcnd.drives.ldcn.packet import CommandCode, PacketReader
from ldcnd.line.flight_recorder import WireEvent
from tests.support.command_line import run_here, virtual_rig
from tests.support.commissioning import rig_text

MOVING = {CommandCode.LOAD_TRAJECTORY, CommandCode.START_MOTION, CommandCode.STOP_MOTOR, CommandCode.SET_GAIN}
"""Commands by which an axis could begin to move, or its loop be closed or changed."""


@pytest.fixture(autouse=True)
def state_home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "rig.toml"
    path.write_text(rig_text())
    return path


@pytest.fixture
def rig(config, monkeypatch):
    with virtual_rig(monkeypatch, load_config(config)) as rig:
        yield rig


def sent(rig):
    """Return the commands on the wire so far, in their order."""
    records = rig.rig.daemon.rig.buses[0].bus.wire_log.records()
    found = []
    for record in records:
        if record.event is WireEvent.SENT and set(record.data) != {0}:
            reader = PacketReader()
            found += [CommandCode(received.packet.command) for received in map(reader.feed, record.data) if received]
    return found


@pytest.mark.long
def test_nothing_that_moves_is_sent_before_the_confirmation(rig, config):
    before = len(sent(rig))
    listed = rig.run(f"commission x --config {config} --list")
    left = [rig.run(f"commission x --config {config} --step {name}", typed="") for name in ("motor", "scale", "speed")]
    refused = rig.run(f"commission x --config {config} --step motor --for 5", typed="n\n")
    shown = sent(rig)[before:]
    done = rig.run(f"commission x --config {config} --step motor --for 5", typed="y\n")

    assert listed.code == 0
    assert "motor    open         Motor against encoder" in listed.printed
    assert [each.code for each in left] == [1, 1, 1]
    assert all("no answer came; the same command goes on from here" in each.errors for each in left)
    assert refused.code == 0
    assert not MOVING & set(shown)
    assert done.code == 0
    assert "motor    done" in done.printed
    assert MOVING & set(sent(rig)[before + len(shown) :])


@pytest.mark.long
def test_all_steps_are_gone_through_and_the_change_is_shown_and_written(rig, config, tmp_path):
    typed = "\n".join(
        [
            *("y", "hangs", "secured by a strap"),  # load
            "y",  # motor
            "y",  # hold
            *("y", "2", "4.0", "n"),  # scale: twice as far, not written
            *("s", "has none"),  # limits
            *("y", "2"),  # home
            "n",  # gains, not now
            *("y", "-10", "10", "y"),  # travel: written
        ]
    )
    report = tmp_path / "x.html"
    ran = rig.run(f"commission x --config {config} --by ada --for 60 --report {report}", typed=f"{typed}\n")
    listed = rig.run(f"commission x --config {config} --list --json")

    assert ran.code == 0
    assert "-counts_per_unit = 1000 # as ordered" in ran.errors
    assert "+counts_per_unit = 50" in ran.errors
    assert "is changed, and the daemon" in ran.errors
    axis = load_config(config).bus[0].axis[0]
    assert (axis.counts_per_unit, axis.limits.position_min, axis.limits.position_max) == (1000, -9.6, 9.6)
    records = {record["step"]: record for record in map(json.loads, listed.printed.splitlines())}
    assert {name: record["result"]["state"] for name, record in records.items()} == {
        "load": "done",
        "settings": "not_needed",
        "motor": "done",
        "hold": "done",
        "scale": "done",
        "limits": "skipped",
        "home": "done",
        "travel": "done",
        "speed": "open",
        "gains": "open",
    }
    assert records["motor"]["by"] == "ada"
    assert "secured by a strap" in report.read_text()
    assert (tmp_path / "commissioning-bench-x.json").exists()
    assert "other limits than the file" in rig.run(f"commission x --config {config}").errors


def test_what_a_refusal_names_is_typed_with_the_options_that_led_to_its_rig(config, rig):
    rig.wait(rig.rig.client.stop("x"))
    refused = rig.run(f"commission x --config {config} -e tcp/127.0.0.1:7448 --step motor --for 5", typed="yes\n")

    assert refused.code == 1
    assert "ldcnd reset x -e tcp/127.0.0.1:7448 --rig bench" in refused.errors


def test_wrong_usage_and_missing_daemons_have_the_usual_exit_codes(config, rig):
    assert rig.run(f"commission y --config {config} --list").code == 1
    assert rig.run(f"commission x --config {config} --step nothing").code == 2
    assert rig.run(f"commission x --config {config.parent / 'none.toml'}").code == 78
    keyboard = rig.run(f"commission x --config {config} --step scale", typed="y\n2\n")
    assert (keyboard.code, "no keyboard" in keyboard.errors) == (78, True)
    (config.parent / "commissioning-bench-x.json").write_text("{")
    assert rig.run(f"commission x --config {config} --list").code == 78


@pytest.mark.real_time
def test_without_a_daemon_it_says_so(config, monkeypatch):
    monkeypatch.setenv("LDCND_CONNECT", "127.0.0.1:1")

    assert run_here("commission", "x", "--config", str(config), "--list").code == 3
