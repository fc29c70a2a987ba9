"""Runs of a plan in a Tiled server, written by Bluesky's own TiledWriter and read by Tiled's client."""

import gc
import warnings
from collections.abc import Iterator

import bluesky.plans as bp
import pytest
from bluesky.callbacks.tiled_writer import TiledWriter
from bluesky.utils import FailedStatus
from tiled.client import from_uri
from tiled.client.container import Container
from tiled.server import SimpleTiledServer

from ldcnd.lab.bluesky import Fly
from tests.integration.test_bluesky import flown
from tests.support.bluesky_engine import laboratory

pytestmark = [pytest.mark.edges, pytest.mark.timeout(300)]


@pytest.fixture
def catalog(tmp_path) -> Iterator[Container]:
    with SimpleTiledServer(tmp_path) as server:
        client = from_uri(server.uri)
        yield client
        client.context.close()
    with warnings.catch_warnings(action="ignore"):
        gc.collect()  # connections that Tiled leaves open


@pytest.mark.filterwarnings("default")  # Tiled's own
def test_scans_flights_and_failed_runs_are_in_tiled_as_they_were_emitted(catalog: Container) -> None:
    def emitted(name: str, stream: str) -> list[float]:
        return [value for page in pages if page["stream"] == stream for value in page["data"][name]]

    with laboratory() as lab, lab.powered("x", "y") as (x, y):
        lab.engine.subscribe(TiledWriter(catalog))
        adc, state = (lab.devices.signal("x", item) for item in ("adc", "state"))
        lab.engine(bp.scan([adc, state], x, 0, 4, 5))
        both = lab.devices.flight(x, y)
        lab.engine(flown(both, {"x": Fly(0, 10, velocity=5), "y": Fly(0, -4, velocity=2)}, "both", flush_period=0.5))
        with pytest.raises(FailedStatus):
            lab.engine(bp.scan([], x, 90, 110, 3))
    streams = {each["uid"]: each["name"] for each in lab.documents.of("descriptor")}
    pages = [{"stream": streams[page["descriptor"]], "data": page["data"]} for page in lab.documents.of("event_page")]
    starts = [start["uid"] for start in lab.documents.of("start")]
    scan, flight, failed = (catalog[uid] for uid in starts)
    primary, flown_both = scan["primary"].read(), flight["both"].read()

    assert [run.metadata["stop"]["exit_status"] for run in (scan, flight, failed)] == ["success", "success", "fail"]
    of_scan = [event["data"] for event in lab.documents.of("event")[:5]]
    for name in ("x", "x_setpoint", "x_adc", "x_state"):
        assert primary[name].to_numpy().tolist() == [data[name] for data in of_scan]
    for name in ("x", "y"):
        assert flown_both[name].to_numpy().tolist() == emitted(name, "both")
    assert scan["primary"].metadata["data_keys"]["x"]["units"] == "mm"
    assert len(failed["primary"].read()["x"]) < 3
