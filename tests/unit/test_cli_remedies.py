"""Remedies that name commands of the daemon's interface are said as what can be typed, or pressed."""

import re
from pathlib import Path

import ldcnd
from ldcnd.cli.output import in_typed_terms
from ldcnd.model.commands import Verb

SOURCES = Path(ldcnd.__file__).parent
PAGE_TERMS = SOURCES / "console" / "static" / "parts" / "remedies.js"


def remedies():
    """Return all that the daemon and the drivers advise."""
    found = set()
    for folder in ("daemon", "drivers", "client"):
        for path in (SOURCES / folder).rglob("*.py"):
            found |= set(re.findall(r"""remedy=f?(["'])(.*?)\1""", path.read_text(encoding="utf-8")))
    return {text for _, text in found}


def test_no_remedy_tells_people_to_send_a_verb():
    said = {text: in_typed_terms(text, "x") for text in remedies()}

    verbs = "|".join(Verb)
    left = {text for text in said.values() if re.search(rf"send ({verbs})\b", text)}
    assert not left
    assert in_typed_terms('send power {"on": true}', "x") == "ldcnd axis power x on"
    assert any("ldcnd axis reset x" in text for text in said.values())
