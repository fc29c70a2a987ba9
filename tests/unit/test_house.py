"""A poll, a move and a trace request pass no more files than they are known to need."""

import re

import pytest

from tests.house import FLOWS, way_of
from tests.support.process import ROOT

MOST_FILES = {"poll": 14, "move": 24, "trace": 17}
MOST_ENTRANCES = {"poll": 38, "move": 153, "trace": 53}
"""Today; these bounds come down as the house gets simpler, and never go up."""


@pytest.mark.parametrize("name", FLOWS)
def test_a_flow_passes_few_files(name):
    way = way_of(name)

    assert 5 < len(way.files) <= MOST_FILES[name]
    assert sum(way.times.values()) <= MOST_ENTRANCES[name]


FAMILIES = re.compile(r"smartstep|\bldcn\b|\bldcn_", re.IGNORECASE)
NAMED = {
    "ldcnd/cli/shadow.py": "watches drives of the one family whose output follows from what is published",
    "ldcnd/families/known.py": "lists the families",
    "ldcnd/families/dissector.py": "Wireshark has one plugin for all lines",
    "ldcnd/messaging/keys.py": "the root of all keys",
}
"""Files that may name a family, and why."""


def test_nothing_outside_its_folders_names_a_family():
    files = [path.relative_to(ROOT) for path in (ROOT / "ldcnd").rglob("*.py")]
    outside = [path for path in files if not {"ldcn", "smartstep"} & set(path.parts) and str(path) not in NAMED]

    assert [str(path) for path in outside if FAMILIES.search((ROOT / path).read_text(encoding="utf-8"))] == []
