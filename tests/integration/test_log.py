"""What happened on a rig is told in one order: by whom, with what result, faults and what drives did by themselves."""

import asyncio
import csv
import json

import pytest

from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from tests.support.command_line import virtual_rig


@pytest.fixture
def chain():
    return build_chain(ChainSpec(tuple(map(ModuleSpec, ("ls182ap", "ls182ap", "picservo-v4", "picservo-v4")))))


@pytest.fixture
def rig(monkeypatch, chain):
    with virtual_rig(monkeypatch, chains={"line0": chain}) as found:
        for axis in "xy":
            found.wait(found.rig.until(axis, lambda state: state.link == "up"))
        for line in ("power on x", "move x 5 --wait", "move x 500", "power on y", "stop"):
            found.run(line)
        yield found


def rows(rig, words=""):
    printed = rig.run(f"log --json {words}").printed.splitlines()
    return [json.loads(line) for line in printed if line.startswith("{")]  # the daemon logs beside


def test_commands_stand_in_their_order_with_what_became_of_them(rig):
    found = rows(rig, "--axis x --kind command")
    told = [(row["what"], row["how"]) for row in found]
    assert told == [
        ("power on", "done"),
        ("move_absolute", "done"),
        ("move_absolute", "refused"),
        ("stop", "done"),
    ]
    assert [row["t"] for row in found] == sorted(row["t"] for row in found)
    assert found[1]["position"] == pytest.approx(5, abs=0.02)
    assert found[2]["code"] == "position_limit"
    assert {row["line"] for row in found} == {"line0"}


def test_rows_are_filtered_and_exported(rig):
    assert {row["axis"] for row in rows(rig, "--axis y")} == {"y", ""}
    assert rows(rig, "--kind fault") == []
    assert rows(rig, "--since 2100-01-01") == []
    assert len(rows(rig, "--count 2")) == 2
    printed = rig.run("log --csv").printed
    table = list(csv.DictReader(printed[printed.index("t,kind,") :].splitlines()))
    assert [row["what"] for row in table] == [row["what"] for row in rows(rig)]


@pytest.mark.parametrize("since", ["yesterday", "10", "10x", "-5m"])
@pytest.mark.sweep(2)
def test_what_is_no_time_is_refused(rig, since):
    refused = rig.run(f"log --since {since}")
    assert refused.code == 2
    assert "10m" in refused.errors


def test_the_former_name_leads_to_the_new_one(rig):
    refused = rig.run("events --axis x")
    assert "type `ldcnd log --axis x`" in refused.errors


def test_a_fault_stands_among_the_commands(rig, chain):
    rig.run("reset")
    chain.modules[0].shaft.stalled = True
    rig.run("power on x")
    rig.run("move x 20 --wait")
    rig.wait(rig.rig.until("x", lambda state: state.state == "error_stop"))
    faults = rows(rig, "--kind fault")
    assert [row["what"] for row in faults] == ["overcurrent"]
    everything = [row["what"] for row in rows(rig)]
    assert everything.index("overcurrent") > everything.index("power on")


def test_who_switched_off_and_when_the_daemon_was_started_can_be_told(rig):
    rig.run("power off y")
    found = rows(rig)

    assert [row["what"] for row in rows(rig, "--axis y") if row["what"].startswith("power")] == [
        "power on",
        "power off",
    ]
    assert (found[0]["kind"], found[0]["what"]) == ("daemon", "started")
    assert f"run {rig.wait(rig.rig.client.daemon()).instance}" in found[0]["why"]


def go_on(rig):
    """Take the stop of the fixture back."""
    rig.wait(rig.rig.until("x", lambda state: state.moving == "no"))
    rig.run("reset")
    rig.run("power on x")


def test_an_aborted_move_is_told_with_its_target_and_where_the_axis_was_read_last(rig):
    go_on(rig)
    rig.run("move x 60 --velocity 5")
    while rig.wait(rig.rig.client.position("x")).value < 6:
        rig.wait(asyncio.sleep(0.1))  # virtual
    rig.run("halt x --wait")

    rig.wait(rig.rig.until("x", lambda state: state.moving == "no"))
    move, halt = rows(rig, "--axis x --kind command")[-2:]
    assert (move["what"], move["how"], halt["what"], halt["how"]) == ("move_absolute", "aborted", "halt", "done")
    assert (move["target"], move["position"], halt["target"]) == (60.0, None, None)
    assert 4.9 < move["last_position"] <= halt["position"] < 60.0
    line = rig.run("log --axis x --kind command").printed.splitlines()[-2]
    assert f"to 60 last read at {move['last_position']:.6g}" in line


def test_a_move_to_a_distance_is_told_with_the_place_and_a_motion_at_a_velocity_without_one(rig):
    go_on(rig)
    rig.run("move x 2 --relative --wait")
    rig.run("move x 1 --at-velocity")
    rig.run("halt x --wait")

    rig.wait(rig.rig.until("x", lambda state: state.moving == "no"))
    told = {row["what"]: row for row in rows(rig, "--axis x --kind command")}
    assert told["move_relative"]["target"] == pytest.approx(7.0, abs=0.02)
    assert told["move_relative"]["position"] == pytest.approx(7.0, abs=0.02)
    assert told["move_velocity"]["target"] is None
    assert told["move_velocity"]["last_position"] is not None
