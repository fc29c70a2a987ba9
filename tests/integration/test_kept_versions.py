"""What each released version has left on disks is read today: configuration, state directory, captures, recordings."""

import shutil
from pathlib import Path

import pytest

from ldcnd.contract.commands import MoveAbsolute
from ldcnd.contract.errors import StopLatched
from ldcnd.contract.events import ReadEvents
from ldcnd.contract.samples import LinkState
from ldcnd.lab.recording.reading import Recording, axis_history
from ldcnd.line.capture import parse_capture
from tests.kept_files import FILES, kept_rig
from tests.support.pages import ROOT
from tests.support.rig import running_rig

VERSIONS = sorted(path.parent for path in ROOT.glob("tests/kept/*/contract.txt"))

pytestmark = pytest.mark.parametrize("place", VERSIONS, ids=[place.name for place in VERSIONS])


def test_each_version_has_left_its_files(place: Path):
    assert [name for name in FILES if not (place / name).exists()] == [], "run `python -m tests.kept_files`"


async def test_a_daemon_goes_on_with_the_state_of_an_earlier_one(tmp_path: Path, place: Path):
    state_dir = tmp_path / "state"
    shutil.copytree(place / "state", state_dir)
    async with running_rig(kept_rig(place, state_dir)) as rig:
        x = await rig.until("x", lambda state: state.link is LinkState.UP)
        await rig.until("feed", lambda state: state.link is LinkState.UP)
        described = {info.axis: info for info in await rig.client.axes()}
        events = (await rig.client.ask(ReadEvents(axis="x"))).events
        with pytest.raises(StopLatched):
            await rig.client.command("x", MoveAbsolute(position=1.0))

    assert x.stop_latched
    assert [fault.code for fault in described["x"].past_faults][:1] == ["position_error"]
    # the drives are new ones, which have not the mark of the kept reference
    assert not x.referenced
    assert [event for event in events if event.verb == "reference"]
    assert '"Pn102": 1' in (state_dir / "eeprom-writes.json").read_text()


def test_captures_are_read(place: Path):
    captures = list((place / "state" / "captures").glob("*.capture"))

    assert captures
    for capture in captures:
        read = parse_capture(capture.read_text(encoding="utf-8"))
        assert read.header.config
        assert len(read.records) > 50


def test_recordings_are_read(place: Path):
    recording = Recording(place / "run.mcap")

    history = axis_history(recording, "x")

    assert (recording.damages, history.not_understood) == ([], 0)
    assert history.faults
    assert len(history.series) > 2
