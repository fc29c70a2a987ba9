"""A poll, a move and a trace request are followed from end to end."""

import pytest

from tests.house import FLOWS, way_of

QUERY = ("net/hand_over.py Intake.admit", "net/hand_over.py Query.finish")
ENDS = {
    "poll": ("line/line.py Line.data_received", "net/publisher.py Topic.publish"),
    "move": QUERY,
    "move of the console": (
        "console/gate.py RequestGate.__call__",
        "console/gate.py RequestGate.__call__.<locals>.send_with_headers",
    ),
    "trace": QUERY,
    "trace of a SmartStep": QUERY,
}
"""Where each begins and ends: a way that ends early looks short. Whoever renames these renames them here."""


@pytest.mark.parametrize("name", FLOWS)
@pytest.mark.sweep(2)
def test_a_flow_is_followed_to_its_end(name):
    way = way_of(name)

    assert (way.first, way.last) == ENDS[name]
    assert len(way.times) > 5
