"""The scripts of this folder, tried on the rig of this folder, and what they do when something breaks."""

import csv

import pytest
from autofocus import autofocus
from park import park
from scan import scan

import ldcnd

pytestmark = pytest.mark.ldcnd_rig("rig.toml")


def rows(file):
    with file.open() as opened:
        return [float(row["there"]) for row in csv.DictReader(opened)]


async def test_the_scan_writes_where_the_stage_stood(ldcnd_rig, tmp_path):
    await scan(ldcnd_rig.client, tmp_path / "scan.csv")
    assert rows(tmp_path / "scan.csv") == pytest.approx(range(0, 91, 10), abs=0.02)


async def test_a_scan_that_jams_keeps_the_rows_so_far(ldcnd_rig, tmp_path):
    ldcnd_rig.faults.jam("x", at=45.0)
    with pytest.raises(ldcnd.LdcndError):
        await scan(ldcnd_rig.client, tmp_path / "scan.csv")
    assert rows(tmp_path / "scan.csv") == pytest.approx([0, 10, 20, 30, 40], abs=0.02)
    assert ldcnd_rig.truth("x").at_rest


async def test_parking_lifts_the_focus_before_x_moves(ldcnd_rig):
    assert await ldcnd_rig.run_blocking(park) == pytest.approx(-5, abs=0.02)
    assert ldcnd_rig.truth("focus").position == pytest.approx(2.5, abs=0.01)


async def test_x_does_not_move_when_the_focus_cannot_be_lifted(ldcnd_rig):
    ldcnd_rig.faults.jam("focus")
    with pytest.raises(ldcnd.LdcndError):
        await ldcnd_rig.run_blocking(park)
    assert ldcnd_rig.truth("x").counts == pytest.approx(0, abs=20)


async def test_the_focus_stays_where_the_signal_is_highest(ldcnd_rig):
    found = await autofocus(ldcnd_rig.client)
    assert ldcnd_rig.truth("focus").position == pytest.approx(found, abs=0.01)


async def test_a_cable_that_falls_out_ends_the_search(ldcnd_rig):
    ldcnd_rig.faults.cable_cut("focus", at=-0.15)
    with pytest.raises(ldcnd.LdcndError):
        await autofocus(ldcnd_rig.client)
