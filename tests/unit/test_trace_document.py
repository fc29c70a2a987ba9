"""The how-to on traces says what works: its commands parse, its payload and its settings are accepted."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest

from ldcnd.cli.trace import command
from ldcnd.families.smartstep.config import SmartStepTraceConfig
from ldcnd.messaging.codec import decode
from ldcnd.model.traces import TakeTrace

TEXT = (Path(__file__).parents[2] / "docs" / "how-to" / "take-a-trace.md").read_text(encoding="utf-8")


def blocks(language):
    return re.findall(rf"```{language}\n(.*?)```", TEXT, re.DOTALL)


COMMANDS = [line for block in blocks("sh") for line in block.splitlines()]


@pytest.mark.parametrize("line", COMMANDS)
def test_every_command_of_the_page_is_one(line):
    program, noun, verb, *arguments = shlex.split(line)
    subcommand = command.commands[verb]

    context = subcommand.make_context(verb, arguments)

    assert (program, noun) == ("ldcnd", "trace")
    assert context.params


def test_every_subcommand_is_on_the_page():
    assert {shlex.split(line)[2] for line in COMMANDS} == set(command.commands)


def test_the_payload_of_the_page_is_a_request():
    (payload,) = blocks("json")

    assert decode(TakeTrace, payload.encode(), "application/json").samples == 300


def test_the_settings_of_the_page_are_those_that_hold_anyway():
    (settings,) = blocks("toml")

    table = tomllib.loads(settings)["bus"]["axis"]["smartstep"]["trace"]

    assert SmartStepTraceConfig.model_validate(table) == SmartStepTraceConfig()
