"""What goes wrong with a machine shows in what its motions take; a healthy one raises no alarm."""

import copy
from dataclasses import dataclass, replace

import pytest

from ldcnd.bench.tuning.effort import MOST_GAP_S, EffortMeter, SeenPosition
from ldcnd.bench.tuning.plant import Plant
from ldcnd.bench.tuning.shadow import LEARNT_MOTIONS, FigureAlarm, FigureName, Shadow
from ldcnd.bench.tuning.watching import meaning
from ldcnd.drives.ldcn.profiles import LS_182AP, PIC_SERVO_SC
from tests.support.simulated_plants import drawn_plants
from tests.support.watched_plants import AxisAtWork

SEED = 24
PLANTS = 20
FOUND_WITHIN = 40
"""Motions."""
FAR_COUNTS = 100_000
LOST_WITHIN = 2
"""Motions without one phase."""
MOTIONS_IN_TEN_HOURS = 1800
"""Of an axis that moves every 20 s."""
TAUGHT = LEARNT_MOTIONS + 10  # a figure of two motions takes some more

CHANGES = {
    "friction +50 %": (lambda axis: axis.gets(friction_nm=1.5), {FigureName.FRICTION}),
    "inertia x2": (lambda axis: axis.gets(inertia_kg_m2=2.0), {FigureName.INERTIA}),
    "coupling slips": (lambda axis: axis.slips(0.5), set(FigureName)),
}


@dataclass
class Watched:
    axis: AxisAtWork
    shadow: Shadow

    @classmethod
    def taught(cls, drawn):
        axis = AxisAtWork((LS_182AP, PIC_SERVO_SC)[drawn.number % 2], drawn)
        watched = cls(axis, Shadow(axis.profile, axis.plant, axis.gains))
        assert watched.alarms(TAUGHT) == []
        assert not watched.shadow.is_learning
        return watched

    def alarms(self, motions: int) -> list[tuple[int, FigureAlarm]]:
        return [
            (motion, alarm)
            for motion in range(1, motions + 1)
            for seen in self.axis.motion()
            for alarm in self.shadow.take(seen)
        ]


def prompt(number: int):
    """Return a drawn machine without dead time, which takes a third of the processor time."""
    drawn = list(drawn_plants(SEED, PLANTS))[number]
    return replace(drawn, motor=drawn.motor.model_copy(update={"delay_s": 0.0}))


@pytest.fixture(scope="module", params=[2, 13])
def taught(request):
    return Watched.taught(prompt(request.param))


ONE_MACHINE = pytest.mark.parametrize("taught", [13], indirect=True)


def efforts(axis, motions, *, every=1):
    meter = EffortMeter(axis.profile, axis.plant, axis.gains)
    seen = [each for _ in range(motions) for each in axis.motion()]
    return [effort for each in seen[::every] if (effort := meter.take(each))]


@pytest.mark.parametrize("profile", [LS_182AP, PIC_SERVO_SC], ids=lambda profile: profile.name)
def test_motions_from_rest_to_rest_give_inertia_and_friction(profile):
    drawn = prompt(2)
    axis = AxisAtWork(profile, drawn, knowledge=0.0)
    true = Plant.of(drawn.motor)

    shown = efforts(axis, 6)

    assert len(shown) == 6
    forward, reverse = ([each.against_pwm for each in shown if each.way_counts * way > 0] for way in (1, -1))
    assert [each.inertia for each in shown] == pytest.approx([1.0] * 6, abs=0.1)
    assert (sum(forward) - sum(reverse)) / 6 == pytest.approx(true.friction_pwm, rel=0.2)


def test_positions_too_far_apart_in_a_motion_give_nothing():
    axis = AxisAtWork(LS_182AP, prompt(2), sample_s=MOST_GAP_S * 1.2)

    assert efforts(axis, 4) == []


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.sweep(4)
def test_a_change_is_found(taught, change):
    print(found(taught, change))


@ONE_MACHINE
def test_an_alarm_ends_when_the_axis_is_as_it_was(taught):
    watched = copy.deepcopy(taught)
    watched.axis.gets(friction_nm=1.5)
    watched.alarms(25)
    watched.axis.gets(friction_nm=1 / 1.5)

    alarms = [alarm for _, alarm in watched.alarms(25) if alarm.figure is FigureName.FRICTION]

    assert [alarm.over for alarm in alarms] == [True]
    assert not watched.shadow.standing


@ONE_MACHINE
def test_what_was_learnt_is_used_again(taught):
    watched = copy.deepcopy(taught)
    watched.shadow = Shadow(watched.axis.profile, watched.axis.plant, watched.axis.gains, watched.shadow.memory)
    assert not watched.shadow.is_learning
    watched.axis.gets(friction_nm=1.5)

    assert watched.alarms(FOUND_WITHIN)


@ONE_MACHINE
def test_motions_unlike_those_that_taught_are_not_judged(taught):
    watched = copy.deepcopy(taught)
    watched.axis.move = replace(
        watched.axis.move, distance_counts=watched.axis.move.distance_counts // 6,
        speed_counts_per_s=watched.axis.move.speed_counts_per_s / 4,
    )  # fmt: skip

    assert watched.alarms(6) == []
    assert watched.shadow.unlike == 6


def test_a_lost_phase_is_said_with_the_place_where_the_axis_stands(taught):
    print(phase_lost(taught))


@ONE_MACHINE
def test_an_output_that_moves_nothing_is_said_anew_at_another_place_and_ends_after_motions_without(taught):
    watched = copy.deepcopy(taught)
    shadow, axis = watched.shadow, watched.axis

    def stands(counts):
        told = []
        for _ in range(30):
            axis._t_s += 0.01
            told += shadow.take(SeenPosition(axis._t_s, counts, FAR_COUNTS))
        return told

    (first,), (again,), nothing = stands(10**6), stands(10**6 + 500), stands(10**6)
    shadow.restart()  # the loop is opened
    alarms = [alarm for _, alarm in watched.alarms(30) if alarm.figure is FigureName.OUTPUT_AT_REST]

    assert nothing == []
    assert (first.places, again.places) == ((10**6,), (10**6, 10**6 + 500))
    assert "a jam, a hard stop" in meaning(first.figure, more=True, places=first.places)
    assert "hardly a jam" in meaning(again.figure, more=True, places=again.places)
    assert [alarm.over for alarm in alarms] == [True]
    assert FigureName.OUTPUT_AT_REST not in shadow.standing


def phase_lost(taught: Watched) -> str:
    """Assert that a lost phase is said, or opens the loop, in the stated time; return which, and when."""
    watched = copy.deepcopy(taught)
    watched.alarms(1)  # now it stands where its last way, which was drawn, has ended
    watched.axis.loses_phase()
    for motion in range(1, LOST_WITHIN + 1):
        alarms = [alarm for _, alarm in watched.alarms(1)]
        if alarms:
            (alarm,) = alarms
            assert alarm.figure is FigureName.OUTPUT_AT_REST
            assert alarm.value > alarm.high > 2 * alarm.usual
            return f"phase lost: {alarm.value:.0f} PWM steps, {alarm.usual:.1f} usual, after {motion} motions"
        if watched.axis.tripped:
            return f"phase lost: the drive opens its loop in motion {motion}"
    raise AssertionError("a lost phase was not said")


def found(taught: Watched, change: str) -> str:
    """Assert that a change is found; return when, and what stands at the end of the stated time."""
    happens, names = CHANGES[change]
    watched = copy.deepcopy(taught)
    happens(watched.axis)
    alarms = watched.alarms(FOUND_WITHIN)
    assert alarms, change
    assert names & watched.shadow.standing.keys(), change
    first, alarm = alarms[0]
    standing = {name.value: round(each.latest / (each.usual or 1), 2) for name, each in watched.shadow.standing.items()}
    return f"{change}: {alarm.figure} after {first} motions; then {standing}"


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("number", range(PLANTS))
def test_a_drawn_machine_works_for_ten_hours_without_an_alarm_and_each_change_is_found(number):
    drawn = list(drawn_plants(SEED, PLANTS))[number]
    print(drawn)
    taught = Watched.taught(drawn)
    for change in CHANGES:
        print(found(taught, change))
    print(phase_lost(taught))

    assert taught.alarms(MOTIONS_IN_TEN_HOURS - TAUGHT) == []

    print({name.value: learnt for name, learnt in taught.shadow.memory.learnt.items()}, taught.shadow.unlike)
