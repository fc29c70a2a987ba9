"""`ldcnd tune` of a SmartStep: what it says of itself, gains tried in its RAM, records by its own recorder."""

import asyncio
from importlib import import_module

import click
import pytest

from ldcnd.bench.tuning.smartstep import guided
from ldcnd.bench.tuning.smartstep.session import (
    MoveFigures,
    SmartStepTuning,
    check_wanted,
    objection,
    read_tuning,
    try_gains,
)
from ldcnd.cli.smartstep import tune
from ldcnd.client.kept_gains import KeptGains, file_of, keep, kept_for, put_back
from ldcnd.client.rig import Rig
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import NotSupported, ValueOutOfRange, WrongState
from ldcnd.contract.parameters import ReadParameter, WriteParameter
from ldcnd.drives.known import FAMILIES
from tests.support.command_line import virtual_rig
from tests.support.trace_rig import MIXED, trace_rig

WANTED = {"Pn100": 60, "Pn102": 55}
FIGURES = MoveFigures(top_speed_rpm=1000.0, largest_deviation=40.0, typical_deviation=20.0, in_position=0.5)


@pytest.fixture(autouse=True)
def state_home(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


async def in_ram(client):
    values = [(await client.command("feed", ReadParameter(parameter=name))).value for name in WANTED]
    return {value.parameter: value.active for value in values}


async def tried(under_test, *, keeps, speeds=(10_000.0, 10_000.0)):
    """Try gains while pulses come in at these rates, before and after."""
    rates = iter(speeds)

    async def moves(_what):
        under_test.pulses(next(rates))

    async def accepted(_tried):
        return keeps

    client = under_test.rig.client
    found = await read_tuning(client, "feed")
    return await try_gains(client, found, WANTED, 0.5, moves, accepted, lambda _: None)


async def test_its_auto_tuning_and_its_gains_are_read_and_nothing_is_written():
    async with trace_rig() as under_test:
        found = await read_tuning(under_test.rig.client, "feed")
        sent = under_test.sent()

    assert found.auto_tuning_result_percent == 100
    assert not found.switches_rule
    assert [each for each in found.auto_tuning if "online auto-tuning" in each]
    assert {name: value.active for name, value in found.gains.items()}["Pn102"] == 40
    assert not [packet for packet in sent if packet[2:3] == b"1"]
    assert "auto-tuning result (Fn007): 100 %" in guided.shown(found)


async def test_gains_that_are_kept_are_in_ram_and_both_moves_are_shown():
    async with trace_rig() as under_test:
        shown = await tried(under_test, keeps=True)
        left = await in_ram(under_test.rig.client)

    assert shown.kept
    assert left == WANTED
    assert shown.objection is None
    assert shown.before.top_speed_rpm == pytest.approx(shown.after.top_speed_rpm, rel=0.1)
    assert kept_for("mixed", "feed") is None
    assert "ldcnd params set feed Pn100 60 --eeprom" in guided.ending(shown)


async def test_gains_that_are_not_wanted_are_put_back():
    async with trace_rig() as under_test:
        before = await in_ram(under_test.rig.client)
        shown = await tried(under_test, keeps=False)
        left = await in_ram(under_test.rig.client)

    assert not shown.kept
    assert left == before
    assert "not wanted; its old gains are back in RAM" in guided.ending(shown)


async def test_a_motor_that_stands_ends_it_with_the_old_gains():
    async with trace_rig() as under_test:
        before = await in_ram(under_test.rig.client)
        with pytest.raises(WrongState, match="stood while it was recorded"):
            await tried(under_test, keeps=True, speeds=(10_000.0, 0.0))
        left = await in_ram(under_test.rig.client)

    assert left == before
    assert not file_of("mixed", "feed").exists()


async def test_ctrl_c_in_the_middle_of_a_record_puts_the_old_gains_back():
    async with trace_rig() as under_test:
        client = under_test.rig.client
        before = await in_ram(client)
        running = asyncio.create_task(tried(under_test, keeps=True))
        while await in_ram(client) != WANTED:
            await asyncio.sleep(0.1)
        running.cancel()
        await asyncio.wait([running])

        assert await in_ram(client) == before
        assert kept_for("mixed", "feed") is None


async def test_gains_of_a_tuning_that_was_killed_come_back_by_hand():
    async with trace_rig() as under_test:
        client = under_test.rig.client
        before = await in_ram(client)
        keep(KeptGains(rig="mixed", axis="feed", gains=before))
        for name, value in WANTED.items():
            await client.command("feed", WriteParameter(parameter=name, value=value, client="dead"))
        await put_back(Rig(client, await client.daemon()), kept_for("mixed", "feed"), "test")

        assert await in_ram(client) == before
        assert not file_of("mixed", "feed").exists()


async def test_values_that_would_not_be_in_use_are_refused():
    async with trace_rig() as under_test:
        found = await read_tuning(under_test.rig.client, "feed")

    with pytest.raises(ValueOutOfRange, match="Pn000 is none of"):
        check_wanted(found, {"Pn000": 1})
    with pytest.raises(NotSupported, match="its gain switch decides"):
        check_wanted(found.model_copy(update={"switches_rule": True}), WANTED)


def test_the_command_shows_tries_and_puts_back(monkeypatch):
    with virtual_rig(monkeypatch, load_config(MIXED)) as rig:
        shown = rig.run("tune feed")
        kept = rig.run("tune feed --set Pn102=45 --record 0.5 --yes --json")
        nothing = rig.run("tune feed --put-back")
        meaningless = rig.run("tune feed --within 2")

    assert shown.code == 0, shown.errors
    assert "Pn102 = 40  Position loop gain" in shown.printed
    assert kept.code == 0, kept.errors
    report = SmartStepTuning.model_validate_json(kept.printed.splitlines()[-1])
    assert (report.tried, report.kept) == ({"Pn102": 45}, True)
    assert "no gains of an unfinished tuning" in nothing.errors
    assert "--within" in meaningless.errors


def test_a_larger_deviation_and_another_move_are_not_better():
    assert objection(FIGURES, FIGURES) is None
    faster = objection(FIGURES, FIGURES.model_copy(update={"top_speed_rpm": 2000.0}))
    worse = objection(FIGURES, FIGURES.model_copy(update={"typical_deviation": 30.0}))
    assert faster == "the moves were not alike: up to 1000 r/min before, 2000 after"
    assert worse == "the deviation has grown from 20.0 to 30.0 units"


def test_what_was_typed_is_a_parameter_and_a_number():
    assert tune._value("pn10a=7") == ("Pn10A", 7)
    with pytest.raises(click.BadParameter, match="NAME=VALUE"):
        tune._value("gain=7")


def test_every_family_says_how_its_axes_are_tuned():
    for family in FAMILIES.values():
        assert callable(import_module(family.tuning.command).tune)
        assert callable(import_module(family.tuning.page).tune)
