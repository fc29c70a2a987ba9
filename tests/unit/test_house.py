"""A poll, a move and a trace request pass no more files than they are known to need."""

import pytest

from tests.house import FLOWS, way_of

MOST_FILES = {"poll": 14, "move": 24, "trace": 17}
MOST_ENTRANCES = {"poll": 38, "move": 153, "trace": 53}
"""Today; these bounds come down as the house gets simpler, and never go up."""


@pytest.mark.parametrize("name", FLOWS)
def test_a_flow_passes_few_files(name):
    way = way_of(name)

    assert 5 < len(way.files) <= MOST_FILES[name]
    assert sum(way.times.values()) <= MOST_ENTRANCES[name]
