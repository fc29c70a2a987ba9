"""Plants found in traces, gains designed for them, and what the model promises of a move."""

from contextlib import suppress
from dataclasses import replace

import pytest

from ldcnd.bench.tuning.design import (
    GAIN_MARGIN_DB,
    LEAST_PHASE_DEG,
    MOST_OVERSHOOT,
    gains_for,
    margins,
    propose,
    stiff_gains,
    within_authority,
)
from ldcnd.bench.tuning.excitation import PULSE_TICKS, Bounds, Excitation, MoveRecord, TrialOutcome
from ldcnd.bench.tuning.identify import Identified, identify
from ldcnd.bench.tuning.plant import Plant
from ldcnd.bench.tuning.response import Figures, Start, TrapezoidMove, figures, simulate
from ldcnd.bench.tuning.verdict import objection
from ldcnd.contract.commands import SetGains
from ldcnd.contract.errors import DriveFault, ValueOutOfRange
from ldcnd.drives.ldcn.profiles import LS_182AP, PIC_SERVO_SC, PIC_SERVO_V4
from ldcnd.sim.plant import MotorPlant
from tests.support.simulated_plants import REFERENCE, SimulatedAxis, drawn_plants, tuned

SMALL_MOTOR = Plant.of(MotorPlant())
MOVE = TrapezoidMove(500, 20_000.0, 400_000.0)
SEED = 24
CHEAP = (11, 57)
"""Machines of the sixty of `test_sixty_plants.py`: one comes to rest soon, one has hardly any friction."""
WELL_KNOWN = Plant(
    acceleration=0.01 * SMALL_MOTOR.acceleration,
    damping_per_s=1.0,
    friction_pwm=0.1,
    load_pwm=0.1,
    delay_s=0.0003,
    backlash_counts=1.0,
)


def test_a_plant_moves_as_the_machine_that_it_was_made_of():
    machine = MotorPlant(inertia_kg_m2=2e-4, delay_s=0.0007, backlash_counts=5.0, load_nm=0.003, counts_per_rev=8000)

    of_machine = simulate(PIC_SERVO_V4, machine, REFERENCE, MOVE, 0.3)
    of_plant = simulate(PIC_SERVO_V4, Plant.of(machine), REFERENCE, MOVE, 0.3)

    assert max(abs(of_machine.positions - of_plant.positions)) <= 1


def test_a_plant_is_found_again_in_the_machine_that_it_makes():
    plant = Plant(5000.0, 20.0, 3.0, -1.0, 0.001, 4.0)

    again = Plant.of(plant.motor())

    for name in ("acceleration", "damping_per_s", "friction_pwm", "load_pwm", "delay_s", "backlash_counts"):
        assert getattr(again, name) == pytest.approx(getattr(plant, name)), name


def test_overshoot_and_settling_are_those_of_the_record():
    commanded = [0.0, 50.0, 100.0, 100.0, 100.0, 100.0, 100.0, 100.0, 100.0, 100.0, 100.0]
    positions = [0.0, 30.0, 90.0, 108.0, 103.0, 100.0, 100.0, 100.0, 100.0, 100.0, 100.0]

    shown = figures([n / 10 for n in range(11)], positions, commanded, window_counts=2.0)

    assert shown.overshoot == pytest.approx(0.08)
    assert shown.settling_s == pytest.approx(0.2)  # commanded until 0.2 s, outside until 0.4 s
    assert shown.settled
    assert shown.following_error_counts == 20


def test_a_dead_time_takes_its_angle_from_the_phase_margin():
    prompt = margins(PIC_SERVO_V4, SMALL_MOTOR, REFERENCE)
    late = margins(PIC_SERVO_V4, replace(SMALL_MOTOR, delay_s=0.001), REFERENCE)

    assert late.crossover_hz == pytest.approx(prompt.crossover_hz)
    assert prompt.phase_deg - late.phase_deg == pytest.approx(360 * prompt.crossover_hz * 0.001, rel=1e-3)
    assert late.gain_db < prompt.gain_db


def test_a_loop_without_margin_rings_and_one_with_margin_does_not():
    plant = Plant(20_000.0, 20.0, friction_pwm=0.2, delay_s=0.002)
    ringing = replace(REFERENCE, kp=900, kd=2000)

    without, having = (margins(PIC_SERVO_V4, plant, gains) for gains in (ringing, replace(ringing, kp=60)))
    rings, rests = (
        simulate(PIC_SERVO_V4, plant, gains, MOVE, 1.0).positions[-200:] for gains in (ringing, replace(ringing, kp=60))
    )

    assert without.phase_deg < 0
    assert having.phase_deg > 20
    assert max(rings) - min(rings) > 10 * (max(rests) - min(rests))


@pytest.mark.parametrize("profile", [PIC_SERVO_V4, LS_182AP, PIC_SERVO_SC], ids=lambda profile: profile.name)
@pytest.mark.parametrize("wanted_hz", [10.0, 20.0, 40.0])
def test_gains_have_the_bandwidth_and_the_phase_that_were_wanted(profile, wanted_hz):
    plant = Plant(16_000.0, 20.0, friction_pwm=2.0, delay_s=0.0005)

    found = margins(profile, plant, gains_for(profile, plant, wanted_hz, 50.0, 0.1))

    assert found.crossover_hz == pytest.approx(wanted_hz, rel=0.05)
    assert 49.0 < found.phase_deg < 56.0  # the integral costs less than was set aside for it


def test_a_bandwidth_that_no_registers_give_is_refused():
    known = Identified(SMALL_MOTOR, WELL_KNOWN, 0.3)

    with pytest.raises(ValueOutOfRange, match="at 400 Hz"):
        propose(PIC_SERVO_V4, known, MOVE, bandwidth_hz=400.0)


def test_a_proposal_states_its_margins_and_what_the_move_will_look_like():
    plant = replace(SMALL_MOTOR, friction_pwm=3.0, delay_s=0.0006)
    known = Identified(plant, WELL_KNOWN, 0.3)
    move = within_authority(plant, MOVE)

    proposal = propose(PIC_SERVO_V4, known, move, bandwidth_hz=30.0)

    assert proposal.margins == margins(PIC_SERVO_V4, plant, proposal.gains)
    assert proposal.margins.crossover_hz == pytest.approx(30.0, rel=0.1)  # a quick integral lowers it a little
    assert proposal.margins.phase_deg > LEAST_PHASE_DEG
    assert proposal.margins.gain_db > GAIN_MARGIN_DB
    assert proposal.figures.overshoot < MOST_OVERSHOOT
    assert proposal.figures.settled
    assert proposal.gains.el < PIC_SERVO_V4.most_error_limit
    assert not simulate(PIC_SERVO_V4, plant, proposal.gains, move, 0.5).tripped


def test_stiff_gains_follow_a_step_on_a_plant_whose_dead_time_is_not_known():
    heavy = Plant(1425.0, 3.7, friction_pwm=1.4, delay_s=0.0015)
    known = Identified(heavy, replace(WELL_KNOWN, acceleration=14.0), 0.3)

    gains = replace(stiff_gains(PIC_SERVO_V4, known), ki=0, il=0)
    for delay_s in (0.0, 0.003):
        run = simulate(PIC_SERVO_V4, replace(heavy, delay_s=delay_s), gains, TrapezoidMove(250, 25_000.0, 2.5e7), 0.6)

        assert not run.tripped
        assert run.positions[-1] == pytest.approx(250, abs=50)  # friction holds it there


def test_a_move_is_slowed_down_to_half_of_what_the_motor_can_do():
    plant = Plant(1000.0, 20.0, friction_pwm=5.0, load_pwm=-20.0)

    move = within_authority(plant, TrapezoidMove(5000, 1e6, 1e9))

    needed = move.acceleration_counts_per_s2 + move.speed_counts_per_s * plant.damping_per_s
    assert needed / plant.acceleration + 25.0 <= 125.0
    with pytest.raises(ValueOutOfRange, match="friction and load take"):
        within_authority(replace(plant, load_pwm=200.0), move)


def test_a_trace_without_motion_tells_nothing():
    still = MoveRecord(REFERENCE, MOVE, Start(), tuple(n / 400 for n in range(100)), (0,) * 100)

    with pytest.raises(ValueOutOfRange, match="tells too little"):
        identify(PIC_SERVO_V4, [still])


@pytest.mark.parametrize(
    ("wrong", "said"),
    [({"motor_reversed": True}, "against an output"), ({"encoder_disconnected": True}, "the encoder counted nothing")],
    ids=["reversed motor", "disconnected encoder"],
)
def test_wrong_wires_are_found_by_pulses_within_the_distance(wrong, said):
    (plant,) = drawn_plants(SEED, 1)
    axis = SimulatedAxis(PIC_SERVO_V4, replace(plant, motor=plant.motor.model_copy(update=wrong)))

    with pytest.raises(DriveFault, match=said):
        axis.run(Excitation(PIC_SERVO_V4, Bounds(plant.distance_counts)).pulses())

    assert 0 < axis.farthest_counts <= plant.distance_counts


def test_pulses_end_in_the_drive_itself():
    (plant,) = drawn_plants(SEED, 1)
    blind = plant.motor.model_copy(update={"encoder_disconnected": True})
    excitation = Excitation(PIC_SERVO_V4, Bounds(plant.distance_counts))
    pulses = excitation.pulses()
    nothing = TrialOutcome(MoveRecord(REFERENCE, MOVE, Start(), (0.0,), (0,)), tripped=False, rest_counts=0)

    forward = []
    trial = next(pulses)
    with suppress(DriveFault):
        while True:
            run = simulate(PIC_SERVO_V4, blind, trial.gains, trial.move, 0.1)
            assert 0 < sum(abs(run.pwm)) <= PULSE_TICKS * trial.gains.ol
            assert not run.pwm[-1]
            forward.append(max(sum(run.pwm), 0))
            trial = pulses.send(nothing)

    assert sum(forward) <= 2 * excitation.most_impulse


@pytest.mark.parametrize("within", [200, 20_000, 1_000_000])
def test_every_trial_has_gains_that_a_request_takes(within):
    excitation = Excitation(PIC_SERVO_SC, Bounds(within, velocity_counts_per_s=1000.0))
    trials = (excitation.pulses(), excitation.soft(), excitation.stiff(REFERENCE))

    for trial in (*map(next, trials), next(excitation.test(REFERENCE, excitation.wanted(), 1.0))):
        gains = trial.gains
        SetGains(kp=gains.kp, kd=gains.kd, ki=gains.ki, il=gains.il, ol=gains.ol, el=gains.el, sr=gains.sr)
        assert gains.el > 0
        assert trial.move.speed_counts_per_s <= 1000.0
        assert abs(trial.move.distance_counts) <= within // 2


def test_an_axis_that_is_carried_away_between_moves_gets_no_move_that_could_leave_the_distance():
    excitation = Excitation(PIC_SERVO_V4, Bounds(1000), offset_counts=985)
    pulses = excitation.pulses()
    refused = None
    trial = next(pulses)

    try:
        while True:  # by one count, which passes for noise
            assert abs(excitation.offset_counts + trial.move.distance_counts) <= 1000
            still = MoveRecord(trial.gains, trial.move, Start(), (0.0,), (0,))
            trial = pulses.send(TrialOutcome(still, tripped=False, rest_counts=1))
    except DriveFault as error:
        refused = error

    assert "counts from where it stood: the next move could leave" in str(refused)
    assert 990 < refused.value <= 1000


def test_a_distance_that_is_too_short_is_refused():
    with pytest.raises(ValueOutOfRange, match="within 100 counts"):
        Excitation(PIC_SERVO_V4, Bounds(100))


def test_gains_are_not_better_when_they_settle_later_overshoot_or_trip():
    good = Figures(overshoot=0.05, settling_s=0.05, settled=True, following_error_counts=50.0, error_counts=0.0)

    assert objection(good, good) is None
    assert objection(replace(good, settling_s=0.054), good) is None
    assert objection(good, replace(good, settled=False)) is None
    assert "with the old gains in 50 ms" in objection(replace(good, settling_s=0.056), good)
    assert "overshot by 16%" in objection(replace(good, overshoot=0.16), None)
    assert "did not settle" in objection(replace(good, settled=False), None)
    assert "opened its loop" in objection(None, good)


@pytest.mark.timeout(300)  # a second or two of processor time, on a machine that may be busy
@pytest.mark.parametrize("number", CHEAP)
@pytest.mark.sweep(2)
def test_of_a_drawn_machine_traces_tell_the_inertia_and_gains_suit_it(number):
    *_, plant = drawn_plants(SEED, number + 1)
    print(plant)

    outcome = tuned(PIC_SERVO_V4, plant, bandwidth_hz=23.0)  # to search all would cost seconds

    assert outcome.acceleration_error < 0.1
    assert outcome.measured is not None
    assert outcome.measured.settled
    assert outcome.measured.overshoot < 0.15
    assert outcome.farthest_counts <= plant.distance_counts
