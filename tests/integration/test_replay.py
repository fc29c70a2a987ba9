"""Captures that are kept as test data are played to the daemon: it publishes what it published then, bit for bit."""

import json
import re
from dataclasses import replace

import pytest

from ldcnd.config.rig import load_config
from ldcnd.contract.errors import ConfigError, MalformedRequest
from ldcnd.daemon.capture import config_of
from ldcnd.line.capture import Capture, parse_capture
from ldcnd.line.flight_recorder import WireEvent, WireRecord
from tests.support.captures import FOLDER, NAMES, record, replayed
from tests.support.recorded_line import ReplayDeviation


def kept(name):
    """Return a capture that is kept, and what the daemon published when it was made."""
    capture = parse_capture((FOLDER / f"{name}.capture").read_text(encoding="utf-8"))
    return capture, tuple((FOLDER / f"{name}.jsonl").read_text(encoding="utf-8").splitlines())


def of_any_version(published):
    """Return what was published without the version of the daemon, which tells of it in its health."""
    return tuple(re.sub(r'"version":"[^"]*"', "", line) for line in published)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.sweep(2)
def test_a_capture_brings_back_every_sample_and_event_bit_for_bit_and_again(name):
    capture, published = kept(name)

    once, again = replayed(capture), replayed(capture)

    assert of_any_version(once) == of_any_version(published)
    assert again == once


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.sweep(2)
def test_what_is_captured_now_can_be_played_back_from_its_text(name):
    recording = record(name)

    capture = parse_capture(recording.text)

    assert capture == recording.capture
    assert replayed(capture) == recording.published


def values(published, key):
    """Return the values of a key, oldest first."""
    lines = [json.loads(line) for line in published]
    return [line["value"] for line in lines if line["key"] == f"ldcn/bench/tele/{key}"]


def test_the_captures_show_what_they_are_named_for():
    published = {name: kept(name)[1] for name in NAMES}
    moves = {
        name: [event for event in values(lines, "x/event") if event["verb"] == "move_absolute"]
        for name, lines in published.items()
    }
    ends = {name: events[-1] for name, events in moves.items()}

    assert (ends["clean_start"]["verb"], ends["clean_start"]["status"]) == ("move_absolute", "done")
    assert values(published["clean_start"], "x/position")[-1]["value"] == pytest.approx(15.0, abs=0.01)
    assert (ends["power_loss"]["status"], ends["power_loss"]["client"]) == ("failed", "bench")
    assert values(published["power_loss"], "x/state")[-1]["state"] == "error_stop"
    assert ends["corrupted_line"]["status"] == "done"
    assert "is damaged" in {record.note for record in kept("corrupted_line")[0].records}


def spoilt(capture, number, **changes):
    """Return the capture with another record of that number."""
    records = list(capture.records)
    records[number] = replace(records[number], **changes)
    return replace(capture, records=tuple(records))


def sent_numbers(capture):
    return [number for number, each in enumerate(capture.records) if each.event is WireEvent.SENT]


def test_the_first_packet_that_is_another_one_ends_the_replay_and_is_named():
    capture, _ = kept("clean_start")
    number = sent_numbers(capture)[99]
    at_s, data = capture.records[number].at_s, capture.records[number].data

    with pytest.raises(ReplayDeviation) as deviation:
        replayed(spoilt(capture, number, data=b"\xaa\x01\x02"))

    assert str(deviation.value) == (
        f"packet 100 (record {number}, {at_s:.9f} s): expected 'sent aa 01 02',"
        f" got 'sent {data.hex(' ')}' at {at_s:.9f} s"
    )


def test_a_packet_that_does_not_come_ends_the_replay_and_is_named():
    capture, _ = kept("clean_start")
    last = capture.records[sent_numbers(capture)[-1]]
    never_sent = WireRecord(last.at_s + 0.001, WireEvent.SENT, b"\xaa\x7f\x0e\x8d")
    header = capture.header.model_copy(update={"until_s": last.at_s + 10.0})

    with pytest.raises(ReplayDeviation, match="expected 'sent aa 7f 0e 8d', got"):
        replayed(Capture(header, (*capture.records, never_sent)))


def test_another_configuration_is_told_by_the_packet_that_it_changes():
    capture, _ = kept("clean_start")
    config = config_of(capture.header)
    (line,) = config.bus
    x = line.axis[0].model_copy(update={"velocity": 10.0})
    config = config.model_copy(update={"bus": (line.model_copy(update={"axis": (x, *line.axis[1:])}),)})

    with pytest.raises(ReplayDeviation, match=r"expected 'sent .*', got 'sent "):
        replayed(capture, config)


def test_a_capture_that_has_lost_its_beginning_is_refused():
    capture, _ = kept("clean_start")
    header = capture.header.model_copy(update={"first_record": 12})

    with pytest.raises(MalformedRequest, match="begins with record 12"):
        replayed(replace(capture, header=header))


def test_without_a_configuration_the_capture_asks_for_one():
    capture, _ = kept("clean_start")
    header = capture.header.model_copy(update={"config": None})

    with pytest.raises(ConfigError, match="no configuration"):
        config_of(header)

    assert config_of(header, load_config(FOLDER / "clean_start.toml")).bus == config_of(capture.header).bus
