"""Recordings and traces in Arrow's own library: Parquet files with types, and columns that it takes as they are."""

import asyncio

import pandas as pd
import pyarrow as pa
import pytest
from pyarrow import parquet

import ldcnd
from ldcnd.contract.commands import MoveAbsolute, Power
from ldcnd.contract.samples import AxisState
from ldcnd.lab.recording.tables import export_tables
from tests.support.bluesky_engine import laboratory
from tests.support.recordings import recorded_rig

pytestmark = [pytest.mark.edges, pytest.mark.timeout(300)]


async def test_tables_are_parquet_files_with_types(tmp_path):
    path = tmp_path / "run.mcap"
    async with recorded_rig(path) as recorded:
        client = recorded.rig.client
        await recorded.rig.until("x", lambda state: state.state is AxisState.DISABLED)
        await client.command("x", Power(on=True))
        reply = await client.command("x", MoveAbsolute(position=5.0))
        await client.wait_for_end("x", reply.command_id)
    done = export_tables(path, tmp_path / "tables", parquet=True)
    expected = ldcnd.recording(path).table("tele/x/state")
    table = parquet.read_table(tmp_path / "tables" / "ldcn.sim.tele.x.state.parquet")
    positions = parquet.read_table(tmp_path / "tables" / "ldcn.sim.tele.x.position.parquet")

    assert done.rows == sum(parquet.read_metadata(path).num_rows for path in done.tables)
    assert table.to_pydict() == expected
    assert [str(table.schema.field(name).type) for name in ("t_ns", "enabled", "state")] == ["int64", "bool", "string"]
    assert [str(positions.schema.field(name).type) for name in ("value", "counts")] == ["double", "int64"]
    assert pa.table(expected).num_rows == table.num_rows
    assert pd.DataFrame(expected)["t_ns"].tolist() == expected["t_ns"]


async def test_columns_without_values_have_the_types_of_what_is_published(tmp_path):
    path = tmp_path / "run.mcap"
    async with recorded_rig(path) as recorded:
        await recorded.rig.until("x", lambda state: state.state is AxisState.DISABLED)
        await recorded.rig.client.command("x", Power(on=True))
        await asyncio.sleep(1.0)

    export_tables(path, tmp_path / "tables", parquet=True)

    kinds = [
        {
            field.name: str(field.type)
            for field in parquet.read_schema(tmp_path / "tables" / f"ldcn.sim.{topic}.parquet")
        }
        for topic in ("tele.x.position", "tele.y.position", "tele.x.velocity", "tele.x.state")
    ]
    assert (kinds[0]["turns"], kinds[0]["following_error"], kinds[0]["counts"]) == ("int64", "double", "int64")
    assert kinds[0] == kinds[1]
    assert (kinds[3]["last_error"], kinds[3]["target"], kinds[3]["referenced"]) == ("string", "double", "bool")


def test_a_trace_is_a_table_of_columns_with_titles():
    with laboratory() as lab, lab.powered("x") as (x,):
        trace = lab.loop.run(x._axis.take_trace("position", samples=50))
    table = pa.table(trace.table())

    assert table.column_names[:2] == ["offset_ns", "position [mm]"]
    assert table.num_rows == 50
    assert len(repr(trace)) < 2000
