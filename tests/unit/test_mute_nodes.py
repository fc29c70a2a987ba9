import pytest

from ldcnd.line.proof import MISSES_UNTIL_LOST
from ldcnd.line.schedule import LONGEST_BACKOFF_S, MUTE_SHARE, MuteNodes

LOST_S = 0.015


def silent(nodes: MuteNodes, node: int, times: int) -> float:
    """Let a node miss so many polls; return the pause after the last."""
    for _ in range(times):
        nodes.missed(node)
        pause_s = nodes.pause_s(node, LOST_S)
    return pause_s


def test_the_first_misses_are_forgiven():
    assert silent(MuteNodes(), 1, MISSES_UNTIL_LOST - 1) == 0.0


def test_a_mute_node_takes_its_share_of_the_line_and_no_more():
    assert LOST_S / silent(MuteNodes(), 1, 30) == pytest.approx(MUTE_SHARE)


def test_several_mute_nodes_share_the_same_share():
    nodes = MuteNodes()
    silent(nodes, 1, 30)

    assert silent(nodes, 2, 30) == pytest.approx(min(2 * LOST_S / MUTE_SHARE, LONGEST_BACKOFF_S))


def test_no_node_waits_longer_than_the_bound():
    nodes = MuteNodes()

    assert max(silent(nodes, node, 30) for node in range(1, 32)) == LONGEST_BACKOFF_S


def test_an_answer_of_a_node_that_was_given_up_names_the_next_one_in_the_chain():
    nodes = MuteNodes()
    for node in (3, 5, 9):
        silent(nodes, node, 5)

    assert [nodes.answered(5), nodes.answered(9), nodes.answered(3)] == [9, 3, None]


def test_an_answer_after_a_single_miss_names_nobody():
    nodes = MuteNodes()
    silent(nodes, 3, 5)
    silent(nodes, 4, 1)

    assert nodes.answered(4) is None
    assert nodes.failing() == {3}
