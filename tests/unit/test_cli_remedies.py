"""Commands that remedies name are said as what can be typed, or pressed."""

import re
from pathlib import Path

import pytest

import ldcnd
from ldcnd.cli.names import OPTIONS_TYPED, typed
from ldcnd.contract.codec import error_reply, rebuild_error
from ldcnd.contract.commands import Verb
from ldcnd.contract.errors import LeaseHeld, Remedy, step
from tests.support.console_parts import part_of_pages
from tests.support.pages import require_command_line

SOURCES = Path(ldcnd.__file__).parent
PLACEHOLDERS = {
    "AXIS": "x",
    "POSITION": "1",
    "DISTANCE": "1",
    "VELOCITY": "1",
    "KP": "1",
    "EL": "1",
    "COUNTER": "feedback",
    "PERCENT": "50",
    "COMMAND": "true",
}


FROM_A_DAEMON = ("axis", "client", "daemon", "drives")


def texts(*parts):
    files = (path for part in parts for path in (SOURCES / part).rglob("*.py"))
    return [path.read_text(encoding="utf-8") for path in files]


def named(*parts):
    """Return the verbs that remedies name."""
    return {verb for text in texts(*parts) for verb in re.findall(r'step\(\s*["\'](\w+)["\']', text)}


@pytest.mark.parametrize("verb", sorted(named(*FROM_A_DAEMON, "bench", "cli")))
def test_what_a_remedy_names_can_be_typed(verb):
    words = typed(step(verb), None).split()[1:]

    require_command_line([PLACEHOLDERS.get(word, word) for word in words])


def test_what_a_remedy_names_can_be_pressed():
    pressed = set(re.findall(r"^  (\w+): ", part_of_pages("remedies.js"), re.MULTILINE))

    assert named(*FROM_A_DAEMON) <= pressed


def test_no_remedy_hides_a_command_in_its_text():
    hidden = re.compile(rf"""remedy=f?["'][^"']*send ({"|".join(Verb)})\b""")

    assert [text for text in texts(*FROM_A_DAEMON) if hidden.search(text)] == []


def test_steps_travel_with_an_error_and_are_said_by_each_face():
    remedy = Remedy("wait until it is released, or {}", step("acquire", "acquire it with force", force=True))
    received = rebuild_error(error_reply(LeaseHeld("axis x is controlled by ada", axis="x", remedy=remedy)))

    assert received.remedy == "wait until it is released, or acquire it with force"
    assert received.remedy.phrased(lambda each: typed(each, "x")) == (
        "wait until it is released, or ldcnd lease hold --axis x --force -- COMMAND"
    )
    assert typed(step("power", on=True), "x") == "ldcnd power on x"


def test_options_of_the_command_stand_before_a_program_of_the_remedy():
    token = OPTIONS_TYPED.set(" -e tcp/127.0.0.1:7448")
    try:
        held = typed(step("acquire", force=True), "x")
    finally:
        OPTIONS_TYPED.reset(token)

    assert held == "ldcnd lease hold --axis x --force -e tcp/127.0.0.1:7448 -- COMMAND"
