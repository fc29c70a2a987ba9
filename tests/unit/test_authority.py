import pytest

from ldcnd.contract.errors import LeaseExpired, LeaseHeld, LeaseRequired, LeaseUnknown, StaleSequence, UnknownAxis
from ldcnd.daemon.leases import Authority


@pytest.fixture
def leased() -> Authority:
    return Authority(["x", "y"], required=True)


def test_without_a_lease_a_leased_rig_does_not_move(leased):
    with pytest.raises(LeaseRequired) as refusal:
        leased.admit("x", None, None, 0.0)

    assert refusal.value.remedy == "acquire one first"


def test_an_open_rig_moves_for_all_until_somebody_takes_control():
    rig = Authority(["x", "y"], required=False)
    rig.admit("x", None, None, 0.0)

    rig.acquire("ann", ["x"], 1.0, 0.0, force=False)

    with pytest.raises(LeaseHeld, match="ann"):
        rig.admit("x", None, None, 0.5)
    rig.admit("y", None, None, 0.5)
    rig.admit("x", None, None, 1.0)  # the lease has run out: nobody holds x any more


def test_a_lease_covers_what_it_names_and_says_who_sends(leased):
    lease = leased.acquire("ann", ["x"], 1.0, 0.0, force=False).lease

    assert leased.admit("x", lease.token, None, 0.9) == "ann"
    with pytest.raises(LeaseHeld, match="does not cover axis y"):
        leased.admit("y", lease.token, None, 0.9)


def test_a_lease_that_names_nothing_covers_the_rig(leased):
    lease = leased.acquire("ann", [], 1.0, 0.0, force=False).lease

    assert lease.axes == {"x", "y"}


def test_the_next_end_is_the_earliest_one(leased):
    assert leased.next_end_s() == float("inf")
    leased.acquire("ann", ["x"], 5.0, 0.0, force=False)
    sooner = leased.acquire("ben", ["y"], 1.0, 0.0, force=False).lease

    assert leased.next_end_s() == 1.0
    leased.renew(sooner.token, 0.5)
    assert leased.next_end_s() == 1.5
    leased.release(sooner.token, 0.6)
    assert leased.next_end_s() == 5.0


def test_a_renewed_lease_lives_on_and_an_old_one_is_stale(leased):
    lease = leased.acquire("ann", ["x"], 1.0, 0.0, force=False).lease
    leased.renew(lease.token, 0.8)
    leased.admit("x", lease.token, None, 1.7)

    assert [over.client for over in leased.expire(1.8)] == ["ann"]
    for late in (leased.renew, leased.release):
        with pytest.raises(LeaseExpired):
            late(lease.token, 1.9)
    with pytest.raises(LeaseExpired):
        leased.admit("x", lease.token, None, 1.9)


def test_a_lease_has_ended_even_before_anybody_looked(leased):
    lease = leased.acquire("ann", ["x"], 1.0, 0.0, force=False).lease

    with pytest.raises(LeaseExpired):
        leased.admit("x", lease.token, None, 1.0)
    with pytest.raises(LeaseExpired):
        leased.renew(lease.token, 1.0)


def test_a_made_up_lease_is_unknown(leased):
    with pytest.raises(LeaseUnknown):
        leased.admit("x", "0123456789abcdef", None, 0.0)


def test_old_numbers_under_a_lease_are_refused(leased):
    lease = leased.acquire("ann", ["x"], 1.0, 0.0, force=False).lease
    leased.admit("x", lease.token, 5, 0.1)

    for number in (5, 4, 0):
        with pytest.raises(StaleSequence) as refusal:
            leased.admit("x", lease.token, number, 0.2)
        assert (refusal.value.value, refusal.value.limit) == (number, 5)
    leased.admit("x", lease.token, 6, 0.3)


def test_control_is_taken_over_only_by_force(leased):
    first = leased.acquire("ann", ["x"], 1.0, 0.0, force=False).lease
    with pytest.raises(LeaseHeld, match="ann"):
        leased.acquire("bob", ["x", "y"], 1.0, 0.1, force=False)
    assert leased.holder("y") is None

    second = leased.acquire("bob", ["x"], 1.0, 0.1, force=True)

    assert (second.own, second.taken) == ((), (first,))
    assert leased.holder("x") == second.lease
    with pytest.raises(LeaseExpired):
        leased.admit("x", first.token, None, 0.2)


def test_who_has_the_token_may_acquire_again(leased):
    first = leased.acquire("ann", ["x"], 1.0, 0.0, force=False).lease

    second = leased.acquire("ann", ["x"], 1.0, 0.5, force=False, replaces=[first.token])

    assert (second.own, second.taken, leased.holder("x")) == ((first,), (), second.lease)


def test_a_released_axis_is_free(leased):
    lease = leased.acquire("ann", ["x"], 1.0, 0.0, force=False).lease

    leased.release(lease.token, 0.5)

    assert leased.holder("x") is None
    leased.acquire("bob", ["x"], 1.0, 0.6, force=False)


def test_an_axis_that_does_not_exist_cannot_be_acquired(leased):
    with pytest.raises(UnknownAxis, match="'q'"):
        leased.acquire("ann", ["q"], 1.0, 0.0, force=False)


def test_a_command_without_a_lease_does_not_begin_once_another_client_has_the_axis():
    rig = Authority(["x", "y"], required=False)
    rig.admit("x", None, None, 0.0)

    rig.acquire("ann", ["x"], 1.0, 0.1, force=False)

    with pytest.raises(LeaseHeld, match="ann"):
        rig.check_held("x", None, 0.5)
    rig.check_held("y", None, 0.5)
    rig.check_held("x", None, 1.2)  # the lease has run out
