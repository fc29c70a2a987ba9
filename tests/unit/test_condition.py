"""What is wrong with an axis, in words, the worst first."""

import pytest

from ldcnd.contract.condition import Alarm, Place, assess
from ldcnd.contract.health import AxisHealth, ItemHealth
from ldcnd.contract.samples import AxisState, FaultEntry, FaultSample, LinkState, Moving, Quality, StateSample
from ldcnd.contract.troubles import Severity, Trouble, line_troubles


def state(**changes) -> StateSample:
    standing = StateSample(
        t=0,
        t_error_ns=0,
        seq=0,
        quality=Quality.GOOD,
        state=AxisState.STANDSTILL,
        enabled=True,
        referenced=True,
        moving=Moving.NO,
        link=LinkState.UP,
        stop_latched=False,
        command=None,
    )
    return standing.model_copy(update=changes)


def entry(code: str, *, stops: bool = True) -> FaultEntry:
    return FaultEntry(code=code, text=f"remedy of {code}", since=0, source="drive", stops=stops)


def faults(*active: FaultEntry, first: FaultEntry | None = None) -> FaultSample:
    return FaultSample(t=0, t_error_ns=0, seq=0, quality=Quality.GOOD, active=active, first=first)


def health(rate_hz: float, *, wanted_hz: float = 20.0, asked_hz: float | None = None) -> AxisHealth:
    items = () if asked_hz is None else (ItemHealth(item="position", asked_hz=asked_hz, granted_hz=rate_hz),)
    return AxisHealth(
        axis="x",
        link=LinkState.UP,
        sample_age_s=0.0,
        rate_wanted_hz=wanted_hz,
        rate_hz=rate_hz,
        faults=0,
        items=items,
    )


def troubles_of(
    state: StateSample | None, faults: FaultSample | None, health: AxisHealth | None
) -> tuple[Trouble, ...]:
    return assess(state, faults, health).troubles


def said(troubles: tuple[Trouble, ...]) -> list[tuple[Severity, str]]:
    return [(trouble.severity, trouble.text) for trouble in troubles]


def notice(text: str) -> list[tuple[Severity, str]]:
    return [(Severity.NOTICE, text)]


def wrong(text: str) -> list[tuple[Severity, str]]:
    return [(Severity.WRONG, text)]


def test_an_axis_that_is_well_has_none():
    assert troubles_of(state(), faults(), health(20.0)) == ()


def test_what_was_never_heard_of_is_a_doubt():
    assert said(troubles_of(None, None, None)) == notice("nothing was received from it yet")


def test_a_line_that_is_not_up_is_wrong_and_says_why_where_that_is_known():
    assert line_troubles(up=True) == ()
    assert said(line_troubles(up=False)) == wrong("the line is not up")
    assert said(line_troubles(up=False, problem="no such port")) == wrong("the line is not up: no such port")


def test_of_a_drive_that_does_not_answer_nothing_else_is_said():
    gone = state(link=LinkState.DOWN, state=AxisState.ERROR_STOP)

    assert said(troubles_of(gone, None, health(0.0))) == wrong("the drive does not answer")
    assert said(troubles_of(gone, faults(entry("link_lost")), health(0.0))) == wrong("remedy of link_lost")


def test_a_stop_that_no_drive_has_confirmed_comes_before_everything_even_of_a_drive_that_does_not_answer():
    gone = state(link=LinkState.DOWN, stop_latched=True, stop_pending=True)

    assert [trouble.text for trouble in troubles_of(gone, faults(entry("overheat")), None)] == [
        "a stop is NOT confirmed by the drive: use the machine's emergency stop",
        "the drive does not answer",
    ]


def test_faults_that_stop_come_before_warnings_and_the_first_cause_before_its_consequences():
    active = faults(entry("position_wrap", stops=False), entry("position_error"), entry("overheat"))
    caused = active.model_copy(update={"first": entry("overheat")})

    found = troubles_of(state(state=AxisState.ERROR_STOP, stop_latched=True), caused, None)

    assert [(trouble.severity, trouble.text.partition(":")[0]) for trouble in found] == [
        (Severity.WRONG, "overheat"),
        (Severity.WRONG, "position_error"),
        (Severity.NOTICE, "a stop is latched"),
        (Severity.NOTICE, "position_wrap"),
    ]
    assert found[0].text == "overheat: remedy of overheat"


@pytest.mark.parametrize(
    ("last_error", "text"),
    [("home: no switch", "in error stop: home: no switch"), (None, "in error stop: reset it to go on")],
)
def test_an_error_stop_whose_fault_is_over_is_wrong_all_the_same(last_error, text):
    assert said(troubles_of(state(state=AxisState.ERROR_STOP, last_error=last_error), faults(), None)) == wrong(text)


def test_an_error_stop_says_that_its_fault_is_over():
    over = faults().model_copy(update={"first": entry("stop_input")})
    opened = faults().model_copy(update={"first": entry("loop_opened")})
    stopped = state(state=AxisState.ERROR_STOP, last_error="the drive reports a fault")

    text = "in error stop because of stop input, which is over: reset it to go on"
    assert said(troubles_of(stopped, over, None)) == wrong(text)
    assert said(troubles_of(stopped, opened, None)) == wrong("in error stop: the drive reports a fault")


def test_how_the_last_command_ended_is_no_trouble_of_an_axis_that_could_move_on():
    assert troubles_of(state(last_error="home: no switch"), faults(), None) == ()


@pytest.mark.parametrize(
    ("report", "told"),
    [
        (health(16.0), "fewer samples a second than asked for: 16.0 of 20.0"),
        (health(17.0), None),  # a report may miss the sample at its edge
        (health(0.0, wanted_hz=1.0), None),
        (health(0.0, wanted_hz=2.0), "fewer samples a second than asked for: 0.0 of 2.0"),
        (health(1.0, asked_hz=1.0), None),  # as often as the drive is asked
        (health(1.0, asked_hz=20.0), "fewer samples a second than asked for: 1.0 of 20.0"),
    ],
)
def test_samples_that_come_too_seldom_are_told(report, told):
    assert said(troubles_of(state(), faults(), report)) == (notice(told) if told else [])


def test_polls_that_are_missed_explain_a_low_rate():
    found = troubles_of(state(link=LinkState.DEGRADED), faults(), health(1.0))

    assert said(found) == notice("the drive missed its latest polls")


@pytest.mark.parametrize(("age_s", "is_old"), [(0.29, False), (0.31, True)])
def test_the_place_of_a_drive_that_misses_polls_is_old_after_two_more(age_s, is_old):
    """It may have lost its power in motion: where it was seen last is soon not where it is."""
    found = assess(state(link=LinkState.DEGRADED), faults(), health(20.0), age_s=age_s)

    assert (found.place is Place.OLD, found.live) == (is_old, not is_old)


def test_an_axis_that_does_not_answer_may_move_and_is_not_said_to_be_in_error_stop():
    """Its daemon holds it to be in error_stop because it is lost; its shaft may run to its target."""
    gone = state(state=AxisState.ERROR_STOP, link=LinkState.DOWN, moving=Moving.UNKNOWN)
    assert {assess(gone, line_up=up).state for up in (True, False)} == {"unknown, may move"}
    assert assess(state(state=AxisState.DISABLED, link=LinkState.DOWN)).state == "unknown, was disabled"


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"enabled": False}, ["moves with motor off"]),  # its drive has tripped, and has not shown yet that it stands
        ({"stop_pending": True}, []),
        ({}, ["moves without a command"]),
    ],
)
def test_a_search_that_has_failed_on_a_jam_is_not_said_to_move_without_a_command(changes, says):
    failed = state(state=AxisState.ERROR_STOP, moving=Moving.YES, last_error="home: position_error", **changes)

    shorts = [trouble.short for trouble in assess(failed, faults(entry("position_error"))).troubles]

    assert [short for short in shorts if short.startswith("moves")] == says


@pytest.mark.parametrize(
    ("link", "place", "word"), [("up", "known", "standstill"), ("degraded", "old", "unknown, was standstill")]
)
def test_of_a_drive_that_misses_polls_the_last_place_is_soon_not_its_own(link, place, word):
    """It may have lost its power in motion: a second in which all looks well is too long."""
    condition = assess(state(link=LinkState(link)), faults(), health(20.0), age_s=0.5)

    assert (condition.place, condition.state) == (place, word)


@pytest.mark.parametrize("has_reference", [True, False])
def test_a_place_that_is_doubted_on_an_axis_that_answers_leaves_its_state_known(has_reference):
    """A reply was lost and the next word came, or a counter was corrected: the position is read in its turn."""
    doubted = assess(state(has_reference=has_reference), faults(), age_s=2.0, position_quality=Quality.UNCERTAIN)

    assert (doubted.place, doubted.mark, doubted.alarm) == (Place.UNCERTAIN, "uncertain", Alarm.MINOR)
    assert (doubted.live, doubted.state) == (True, "standstill")


@pytest.mark.parametrize(
    ("link", "state_age_s", "live"),
    [("up", 0.5, True), ("up", 57.0, False), ("up", None, False), ("degraded", 0.5, False)],
)
def test_a_place_of_which_nothing_newer_comes_is_old_and_the_state_as_old_as_it_is_itself(link, state_age_s, live):
    old = assess(state(link=LinkState(link)), faults(), age_s=57.0, state_age_s=state_age_s)

    assert (old.place, old.alarm, old.live) == (Place.OLD, Alarm.INVALID, live)
    assert old.state == ("standstill" if live else "unknown, was standstill")


def test_an_axis_whose_daemon_has_only_begun_is_being_reached() -> None:
    condition = assess(None, line_up=None)

    assert condition.mark == "line is being opened"
    assert said(condition.troubles) == notice("its daemon has just begun to open its line")


@pytest.mark.parametrize("override", [0.0, 30.0])
def test_the_override_is_said_of_no_drive_that_others_move(override):
    turning = state(speed_override=override, has_reference=False, moving=Moving.YES, command=None)

    assert not [each for each in assess(turning).troubles if "override" in each.text]
    assert [each for each in assess(state(speed_override=override)).troubles if "override" in each.text]


def test_a_latch_is_said_of_an_axis_that_does_not_answer_too():
    lost = assess(state(link=LinkState.DOWN, stop_latched=True))
    silent = assess(state(link=LinkState.DOWN, stop_latched=True), silence="nothing was heard")

    assert "stop latched" in [each.short for each in lost.troubles]
    assert "stop latched" not in [each.short for each in silent.troubles]
