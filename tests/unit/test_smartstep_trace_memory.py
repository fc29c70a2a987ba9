import pytest

from ldcnd.drivers.smartstep.trace_memory import Chunk, chunk_plan, first_point, require_pre_trigger, unwrap
from ldcnd.errors import BadReply, ValueOutOfRange


def test_default_chunks_fetch_a_trace_in_five():
    plan = chunk_plan(1, 200)

    assert [chunk.address for chunk in plan] == [0x3000, 0x30C8, 0x3190, 0x3258, 0x3320]
    assert {chunk.byte_count for chunk in plan} == {200}
    assert chunk_plan(2, 200)[0].address == 0x3800


def test_last_chunk_may_be_shorter():
    plan = chunk_plan(1, 300)

    assert plan[-1] == Chunk(0x3384, 100)
    assert sum(chunk.byte_count for chunk in plan) == 1000


@pytest.mark.parametrize(("trace", "chunk_bytes"), [(0, 200), (3, 200), (1, 0), (1, 201), (1, 1002)])
def test_impossible_plans_are_refused(trace, chunk_bytes):
    with pytest.raises(ValueOutOfRange):
        chunk_plan(trace, chunk_bytes)


def test_refused_chunk_is_halved_down_to_one_word():
    assert Chunk(0x3000, 6).halves() == (Chunk(0x3000, 2), Chunk(0x3002, 4))
    assert Chunk(0x3000, 2).halves() is None


@pytest.mark.parametrize(
    ("trigger_address", "pre_trigger", "first"), [(20, 100, 420), (100, 100, 0), (0, 0, 0), (7, 0, 7), (0, 499, 1)]
)
def test_ring_begins_at_the_oldest_pre_trigger_point(trigger_address, pre_trigger, first):
    assert first_point(trigger_address, pre_trigger) == first


def test_trigger_sits_after_its_pre_trigger_points():
    ring = list(range(500))

    points = unwrap(ring, first_point(20, 100))

    assert points[100] == 20
    assert (points[0], points[99], points[499]) == (420, 19, 419)


def test_trigger_address_beyond_the_ring_is_a_bad_reply():
    with pytest.raises(BadReply):
        first_point(500, 0)


@pytest.mark.parametrize("points", [-1, 500])
def test_pre_trigger_must_leave_room_for_the_trigger(points):
    with pytest.raises(ValueOutOfRange):
        require_pre_trigger(points)
