"""One class says everything about a command: what goes over the network, and what is derived from it."""

import json
from collections.abc import Iterator

import msgpack
import pytest

from ldcnd.contract.catalogue import AXIS_COMMANDS, AXIS_QUESTIONS, COMMANDS, RIG_COMMANDS, verbs_for
from ldcnd.contract.codec import Encoding, decode, encode
from ldcnd.contract.commands import About, AxisCommand, Capability, Command, CommandReply, Effect, Ends, Verb
from ldcnd.contract.frozen import Frozen, schema_name
from tests.support.process import ROOT
from tools.schemas import all_schemas

VECTORS = json.loads((ROOT / "tests" / "vectors" / "commands.json").read_text(encoding="utf-8"))["commands"]
BY_VERB = {**AXIS_COMMANDS, **AXIS_QUESTIONS, **RIG_COMMANDS}


def test_every_verb_of_an_axis_has_one_class():
    assert list(AXIS_COMMANDS) == list(Verb)
    assert len(BY_VERB) == len(COMMANDS)


def unbounded_integers(schema: object) -> Iterator[object]:
    """Yield integers that may have more bits than MessagePack takes: what repeats them could not be answered."""
    if isinstance(schema, dict):
        if schema.get("type") == "integer" and not {"maximum", "exclusiveMaximum", "enum"} & schema.keys():
            yield schema
        schema = list(schema.values())
    if isinstance(schema, list):
        for each in schema:
            yield from unbounded_integers(each)


@pytest.mark.parametrize("command", COMMANDS, ids=lambda command: command.__name__)
def test_a_command_says_everything_about_itself(command: type[Command[Frozen]]):
    assert command.verb
    assert command.about in About
    assert command.summary().endswith(".")
    assert command.answer_s > 0
    assert not list(unbounded_integers(command.model_json_schema()))
    assert command.reply_model() is not Frozen
    if issubclass(command, AxisCommand):
        assert issubclass(command.reply_model(), CommandReply)
    if command.effect is Effect.QUESTION:
        assert not command.needs_lease()
        assert command.ends is Ends.WITH_REPLY


def test_what_brings_an_axis_to_rest_needs_no_lease():
    assert {verb for verb, command in AXIS_COMMANDS.items() if command.effect is Effect.REST} == {
        Verb.STOP,
        Verb.QUICK_STOP,
        Verb.HALT,
    }


def test_a_drive_takes_what_its_capabilities_stand_for():
    assert verbs_for(*Capability) == frozenset(Verb)
    assert verbs_for(Capability.TRACES) == {Verb.TRACE, Verb.TRACE_ABORT}
    assert Verb.READ_PARAMETER in verbs_for(Capability.PARAMETERS)
    assert Verb.HALT not in verbs_for(Capability.PARAMETERS, Capability.TRACES)


def contains(now: object, recorded: object) -> bool:
    """Tell whether everything that was recorded is still said, perhaps beside more."""
    match now, recorded:
        case dict(), dict():
            return all(name in now and contains(now[name], value) for name, value in recorded.items())
        case list(), list():
            return len(now) == len(recorded) and all(map(contains, now, recorded))
        case _:
            return now == recorded


@pytest.mark.parametrize("verb", VECTORS)
def test_a_payload_of_before_means_what_it_always_did(verb: str):
    """Fields are only ever added: what was recorded is understood, and still sent under the same names."""
    vector = VECTORS[verb]
    recorded = msgpack.unpackb(bytes.fromhex(vector["msgpack"]))

    command = decode(BY_VERB[verb], json.dumps(vector["fields"]).encode(), Encoding.JSON)
    payload, encoding = encode(command, Encoding.MSGPACK)
    now = msgpack.unpackb(payload)

    assert encoding == vector["encoding"]
    assert contains(now, recorded)
    assert decode(BY_VERB[verb], bytes.fromhex(vector["msgpack"]), vector["encoding"]) == command
    assert decode(BY_VERB[verb], vector["json"].encode(), Encoding.JSON) == command


@pytest.mark.long
def test_schema_names_are_the_titles_of_the_schemas():
    for name, text in all_schemas().items():
        assert name == schema_name(type(json.loads(text)["title"], (Frozen,), {}))
