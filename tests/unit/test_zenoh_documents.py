"""What the documents about keys and security say is so: keys and schemas exist."""

import json
import re
from functools import cache
from pathlib import Path

import jsonschema_rs
import pytest
from click.testing import CliRunner

from ldcnd.cli.main import cli
from ldcnd.contract.catalogue import AXIS_COMMANDS, RIG_COMMANDS
from ldcnd.contract.codec import MAX_PAYLOAD_BYTES, Encoding
from ldcnd.contract.commands import Verb
from ldcnd.contract.frozen import Frozen, schema_name
from ldcnd.contract.keys import Keys, matches
from ldcnd.contract.samples import TelemetryItem
from ldcnd.daemon.asyncapi import asyncapi_document, asyncapi_text
from ldcnd.daemon.contract import Kind, all_schemas, as_markdown, channels
from ldcnd.ops.pki.access import RULES

ROOT = Path(__file__).parents[2]
REFERENCE = ROOT / "docs" / "reference"
KEYS = Keys("rig")
document = cache(asyncapi_document)
OFFICIAL = jsonschema_rs.Draft7Validator(
    json.loads((ROOT / "tests" / "vectors" / "asyncapi" / "asyncapi-3.0.0.json").read_text())
)
"""As the AsyncAPI Initiative publishes it."""
DRAFT = "https://json-schema.org/draft/2020-12/schema"


def page(name: str) -> str:
    return (REFERENCE / name).read_text()


def spelled(key: str) -> str:
    return re.sub(r"\{(\w+)\}", lambda name: "0" if name[1] == "index" else name[1], key)


def test_the_page_has_the_keys_of_the_code() -> None:
    assert page("keys.md").endswith(as_markdown()), "run `ldcnd schema keys docs/reference/keys.md`"


def test_the_page_tells_the_encodings_of_the_code() -> None:
    for encoding in Encoding:
        assert encoding.value in page("keys.md")
    assert f"at most {MAX_PAYLOAD_BYTES} bytes" in page("keys.md")


def test_the_page_has_the_access_rules_of_the_code() -> None:
    for rule in RULES:
        keys = ", ".join(f"`{key}`" for key in rule.keys)
        assert f"| `{rule.name}` | {rule.flow} | {', '.join(rule.messages)} | {keys} |" in page("security.md")


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


def references(node: object) -> set[str]:
    if isinstance(node, dict):
        own = {node["$ref"]} if isinstance(node.get("$ref"), str) else set()
        return own.union(*(references(value) for value in node.values()))
    if isinstance(node, list):
        return set().union(*(references(value) for value in node))
    return set()


def test_every_reference_of_the_asyncapi_document_leads_somewhere() -> None:
    for reference in references(document()):
        node: object = document()
        for part in reference.removeprefix("#/").split("/"):
            assert isinstance(node, dict)
            assert part in node, reference
            node = node[part]


def test_the_asyncapi_document_has_the_structure_of_version_3() -> None:
    assert document()["asyncapi"] == "3.0.0"
    assert set(document()) == {"asyncapi", "info", "defaultContentType", "channels", "operations", "components"}
    for name, operation in document()["operations"].items():
        channel = document()["channels"][name]
        own = {f"#/channels/{name}/messages/{message}" for message in channel["messages"]}
        assert operation["channel"] == {"$ref": f"#/channels/{name}"}
        assert operation["action"] in ("send", "receive")
        assert {message["$ref"] for message in operation["messages"]} <= own
        if operation["action"] == "receive":
            assert {message["$ref"] for message in operation["reply"]["messages"]} <= own
            assert len(operation["reply"]["messages"]) == 2
        assert set(channel.get("parameters", {})) == set(re.findall(r"\{(\w+)\}", channel["address"]))
        assert re.fullmatch(r"[A-Za-z0-9._-]+", name)


def test_the_asyncapi_document_is_valid_by_the_official_schema() -> None:
    OFFICIAL.validate(json.loads(asyncapi_text()))


@pytest.mark.parametrize(
    ("path", "wrong"),
    [
        (("asyncapi",), "2.6.0"),
        (("info", "version"), None),
        (("channels", "tele_axis_position", "addresses"), "ldcn"),
        (("operations", "tele_axis_position", "action"), "publish"),
        (("operations", "tele_axis_position", "channel"), "tele_axis_position"),
        (("components", "messages", "position_sample", "payloads"), {}),
    ],
)
def test_the_official_schema_finds_what_is_wrong(path: tuple[str, ...], wrong: object) -> None:
    document = json.loads(asyncapi_text())
    node = document
    for name in path[:-1]:
        node = node[name]
    node[path[-1]] = wrong

    assert not OFFICIAL.is_valid(document)


def test_the_schemas_of_the_asyncapi_document_are_json_schemas() -> None:
    for schema in document()["components"]["schemas"].values():
        assert schema.get("$schema", DRAFT) == DRAFT
        jsonschema_rs.meta.validate({"$schema": DRAFT} | schema)
    json.dumps(document())


def test_the_command_line_renews_the_table_and_nothing_else(tmp_path: Path) -> None:
    copy = tmp_path / "keys.md"
    copy.write_text(page("keys.md").replace("`ldcn/<rig>/@stop/<axis>`", "`old`"))

    result = CliRunner().invoke(cli, ["schema", "keys", str(copy)], catch_exceptions=False)

    assert result.exit_code == 0
    assert copy.read_text() == page("keys.md")
