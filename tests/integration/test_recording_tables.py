"""Recordings as tables."""

import asyncio
import csv
import json

import pytest
from click.testing import CliRunner

import ldcnd
from ldcnd.cli.main import cli
from ldcnd.config.plan import plan_rig
from ldcnd.contract.commands import MoveAbsolute, Power
from ldcnd.contract.errors import ConfigError, MalformedRequest, UnknownAxis
from ldcnd.contract.events import CommandStatus
from ldcnd.contract.samples import AxisState
from ldcnd.lab.recording.tables import export_tables
from tests.support.recordings import recorded_rig
from tests.support.rig import EPOCH_NS, two_axes


async def record_a_move(path):
    async with recorded_rig(path) as recorded:
        rig = recorded.rig
        await rig.until("x", lambda state: state.state is AxisState.DISABLED)
        await rig.client.command("x", Power(on=True))
        reply = await rig.client.command("x", MoveAbsolute(position=5.0))
        await rig.client.wait_for_end("x", reply.command_id)
        await asyncio.sleep(3.0)
    return reply.command_id


def rows(folder, topic):
    with (folder / f"ldcn.sim.{topic}.csv").open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


async def test_each_topic_becomes_a_table_whose_columns_are_its_values(tmp_path):
    path, folder = tmp_path / "run.mcap", tmp_path / "tables"
    command_id = await record_a_move(path)

    done = export_tables(path, folder)

    positions = rows(folder, "tele.x.position")
    assert set(folder.iterdir()) == set(done.tables)
    assert not done.damages
    assert float(positions[-1]["value"]) == pytest.approx(5.0, abs=0.01)
    assert int(positions[-1]["t_ns"]) > int(positions[0]["t_ns"]) > EPOCH_NS
    assert positions[0]["unit"] == "mm"
    assert done.rows == sum(len(rows(folder, table.stem.removeprefix("ldcn.sim."))) for table in done.tables)
    # what is inside of something has a column too, empty where there is nothing
    states = rows(folder, "tele.x.state")
    assert command_id in {state["command.command_id"] for state in states}
    assert states[0]["command.command_id"] == ""
    assert float(rows(folder, "meta.health.line0")[-1]["axes.0.rate_hz"]) > 10
    assert json.loads(rows(folder, "tele.x.fault")[0]["active"]) == []
    assert rows(folder, "tele.x.event")[-1]["event.status"] == CommandStatus.DONE


@pytest.mark.long
async def test_a_topic_is_columns_of_the_same_length(tmp_path):
    await record_a_move(tmp_path / "run.mcap")
    tables = ldcnd.recording(tmp_path / "run.mcap")
    positions, states = tables.table("tele/x/position"), tables.table("/ldcn/sim/tele/x/state")

    assert tables.topics["/ldcn/sim/tele/x/position"] == len(positions["value"]) > 50
    assert list(positions)[:2] == ["t_ns", "received_ns"]
    assert positions["value"][-1] == pytest.approx(5.0, abs=0.01)
    assert {len(column) for column in states.values()} == {len(states["t_ns"])}
    assert None in states["command.command_id"]
    with pytest.raises(ConfigError, match="several topics"):
        tables.table("position")
    with pytest.raises(ConfigError, match="no topic"):
        tables.table("tele/q/position")


async def test_of_a_damaged_recording_the_rest_is_exported_and_it_says_so(tmp_path):
    path, cut = tmp_path / "run.mcap", tmp_path / "cut.mcap.part"
    await record_a_move(path)
    data = path.read_bytes()
    cut.write_bytes(data[: len(data) // 2])

    whole, rest = export_tables(path, tmp_path / "whole"), export_tables(cut, tmp_path / "rest")

    assert 0 < rest.rows < whole.rows
    assert len(rest.damages) == 1


@pytest.mark.long
async def test_tables_are_never_overwritten(tmp_path):
    path, folder = tmp_path / "run.mcap", tmp_path / "tables"
    await record_a_move(path)
    export_tables(path, folder)

    with pytest.raises(ConfigError, match="exists already"):
        export_tables(path, folder)


async def test_a_recording_answers_where_an_axis_was_as_its_daemon_did(tmp_path):
    path = tmp_path / "run.mcap"
    async with recorded_rig(path) as recorded:
        rig = recorded.rig
        await rig.until("x", lambda state: state.state is AxisState.DISABLED)
        await rig.client.command("x", Power(on=True))
        await asyncio.sleep(1.0)
        began = EPOCH_NS + round(asyncio.get_running_loop().time() * 1e9)
        reply = await rig.client.command("x", MoveAbsolute(position=5.0))
        await rig.client.wait_for_end("x", reply.command_id)
        await asyncio.sleep(3.0)
        instants = range(began - 10**8, began + 2 * 10**9, 37_000_000)
        asked = [(await rig.client.at(t, "x"))["x"] for t in instants]
        ranged = (await rig.client.past(f"[{began}..{began + 10**9}]", "x"))["x"]

    told = ldcnd.recording(path)

    for t, by_daemon in zip(instants, asked, strict=True):
        found = told.at("x", t)
        for one, other in ((found.position, by_daemon.position), (found.velocity, by_daemon.velocity)):
            assert one.value == pytest.approx(other.value, abs=1e-9)
            assert (one.lower, one.upper) == pytest.approx((other.lower, other.upper), abs=1e-9)
        assert (found.t, found.quality, found.inputs) == (by_daemon.t, by_daemon.quality, by_daemon.inputs)
    assert [each.t for each in told.between("x", began, began + 10**9)] == [each.t for each in ranged]
    assert told.at("x", began - 10**12).reason
    with pytest.raises(UnknownAxis):
        told.at("nobody", began)
    for no_instant in (-3, 1.5, 2**70, "nonsense"):
        with pytest.raises(MalformedRequest):
            told.at("x", no_instant)
    with pytest.raises(MalformedRequest):
        told.between("x", began + 1, began)
    args = ["axis", "at", "x", str(began), "--recording", str(path)]
    shown = CliRunner().invoke(cli, [*args, "--to", str(began + 10**9), "--json"])
    assert [json.loads(line)["t"] for line in shown.stdout.splitlines()] == [each.t for each in ranged]
    assert CliRunner().invoke(cli, args).stdout.startswith(f"x: {told.at('x', began).position.value:.3f} mm, from ")


def test_a_recording_that_is_not_there_is_an_error_of_the_configuration(tmp_path):
    with pytest.raises(ConfigError, match=r"nope\.mcap"):
        _ = ldcnd.recording(tmp_path / "nope.mcap").topics


async def test_what_was_read_before_a_change_of_the_rates_is_kept_and_a_recording_knows_it_too(tmp_path):
    path = tmp_path / "run.mcap"
    config = two_axes()
    async with recorded_rig(path, config) as recorded:
        rig = recorded.rig
        await rig.until("x", lambda state: state.state is AxisState.DISABLED)
        asked = {}
        for rate_hz in (None, 5.0, 50.0, 1.0):
            if rate_hz is not None:
                rates = [axis.rates.model_copy(update={"position": rate_hz}) for axis in config.bus[0].axis]
                axes = [axis.model_copy(update={"rates": r}) for axis, r in zip(config.bus[0].axis, rates, strict=True)]
                changed = config.model_copy(update={"bus": (config.bus[0].model_copy(update={"axis": tuple(axes)}),)})
                rig.daemon.reconfigure(changed, plan_rig(changed))
            await asyncio.sleep(8.0)
            t = EPOCH_NS + round(asyncio.get_running_loop().time() * 1e9)
            asked[t] = None
            await asyncio.sleep(8.0)
        for t in asked:
            asked[t] = (await rig.client.at(t, "x"))["x"]

    told = ldcnd.recording(path)

    for t, by_daemon in asked.items():
        assert by_daemon.reason is None
        assert told.at("x", t).position == by_daemon.position
        assert told.at("x", t).velocity.upper == pytest.approx(by_daemon.velocity.upper, rel=1e-9)
