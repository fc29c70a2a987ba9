"""What the documents about keys and security say is so: keys and schemas exist."""

import re
from pathlib import Path

import pytest

from ldcnd.contract.catalogue import AXIS_COMMANDS, RIG_COMMANDS
from ldcnd.contract.codec import MAX_PAYLOAD_BYTES, Encoding
from ldcnd.contract.commands import Verb
from ldcnd.contract.frozen import Frozen, schema_name
from ldcnd.contract.keys import Keys, matches
from ldcnd.contract.samples import TelemetryItem
from tools.__main__ import renew_table
from tools.channels import Kind, channels, keys_table
from tools.schemas import all_schemas

ROOT = Path(__file__).parents[2]
REFERENCE = ROOT / "docs" / "reference"
KEYS = Keys("rig")


def page(name: str) -> str:
    return (REFERENCE / name).read_text()


def spelled(key: str) -> str:
    return re.sub(r"\{(\w+)\}", lambda name: "0" if name[1] == "index" else name[1], key)


def test_the_page_has_the_keys_of_the_code() -> None:
    assert page("keys.md").endswith(keys_table()), "run `make fix`"


def test_the_page_tells_the_encodings_of_the_code() -> None:
    for encoding in Encoding:
        assert encoding.value in page("keys.md")
    assert str(MAX_PAYLOAD_BYTES) in page("keys.md")


def test_every_verb_and_every_item_is_a_channel() -> None:
    keys = {spelled(channel.key) for channel in channels()}

    assert {KEYS.command("axis", verb) for verb in Verb} <= keys
    assert {KEYS.command("_", verb) for verb in RIG_COMMANDS} <= keys
    assert {KEYS.telemetry("axis", item) for item in TelemetryItem} <= keys
    assert {KEYS.stop(), KEYS.stop("axis")} <= keys


@pytest.mark.parametrize("channel", channels(), ids=lambda channel: channel.name)
def test_a_channel_lies_where_the_daemon_serves_or_publishes_its_kind(channel) -> None:
    where = {
        Kind.TELEMETRY: KEYS.all_telemetry,
        Kind.NEWS: KEYS.all_telemetry,
        Kind.HEALTH: KEYS.all_meta,
        Kind.DESCRIPTION: KEYS.all_meta,
        Kind.PAST: KEYS.all_telemetry,
        Kind.COMMAND: KEYS.all_commands,
        Kind.STOP: KEYS.all_stops[0],
    }

    assert matches(where[channel.kind], spelled(channel.key))
    assert channel.summary


def test_every_payload_has_a_public_schema() -> None:
    models: set[type[Frozen]] = {model for channel in channels() for model in (channel.sent, channel.taken) if model}

    assert {schema_name(model) for model in models} <= set(all_schemas())


def test_no_verb_of_the_rig_is_described_as_a_motion_of_an_axis() -> None:
    assert not set(RIG_COMMANDS.values()) & set(AXIS_COMMANDS.values())


def test_channel_names_are_unique() -> None:
    names = [channel.name for channel in channels()]

    assert len(names) == len(set(names))


def test_a_page_gets_a_new_table_and_nothing_else(tmp_path: Path) -> None:
    copy = tmp_path / "keys.md"
    copy.write_text(page("keys.md").replace("`@stop/<axis>`", "`old`"))

    renew_table(copy, keys_table())

    assert copy.read_text() == page("keys.md")
