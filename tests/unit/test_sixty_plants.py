"""Sixty machines drawn by lot, tuned from their traces alone."""

from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest

from ldcnd.bench.tuning.excitation import Bounds, Excitation
from ldcnd.bench.tuning.verdict import MOST_MEASURED_OVERSHOOT, objection
from ldcnd.contract.errors import DriveFault, LdcndError
from ldcnd.drives.ldcn.profiles import PIC_SERVO_V4
from tests.support.simulated_plants import DrawnPlant, SimulatedAxis, Tuned, drawn_plants, tuned

SEED = 24
PLANTS = 60
WITHIN = 0.1


@dataclass
class Judged:
    """A machine, and what came of tuning it: an outcome, or a refusal."""

    plant: DrawnPlant
    outcome: Tuned | None = None
    refusal: str = ""

    @classmethod
    def of(cls, plant):
        try:
            return cls(plant, tuned(PIC_SERVO_V4, plant))
        except LdcndError as error:
            return cls(plant, refusal=error.message)

    @property
    def is_identified(self):
        return self.outcome is not None and self.outcome.acceleration_error < WITHIN

    @property
    def is_stable(self):
        measured = self.outcome and self.outcome.measured
        return bool(measured and measured.settled)

    @property
    def settles_as_well(self):
        return self.outcome is not None and objection(self.outcome.measured, self.outcome.reference) is None

    @property
    def overshoots(self):
        measured = self.outcome and self.outcome.measured
        return bool(measured and measured.overshoot > MOST_MEASURED_OVERSHOOT)

    @property
    def is_too_far(self):
        return self.outcome is not None and self.outcome.farthest_counts > self.plant.distance_counts

    def __str__(self):
        if self.outcome is None:
            return f"{self.plant.number:4} refused: {self.refusal}"
        true, known, far = self.outcome.true, self.outcome.known.plant, self.outcome.farthest_counts
        off = (
            f"{known.acceleration / true.acceleration - 1:+6.1%} {known.damping_per_s / true.damping_per_s - 1:+7.1%}"
            f" {known.friction_pwm / true.friction_pwm - 1:+7.1%} {known.load_pwm - true.load_pwm:+6.2f}"
            f" {(known.delay_s - true.delay_s) * 1e3:+6.2f} {known.backlash_counts - true.backlash_counts:+6.1f}"
        )
        moved = " ".join(
            "        trips"
            if each is None
            else f"{each.settling_s * 1e3 if each.settled else 999:7.0f} {each.overshoot:5.1%}"
            for each in (self.outcome.measured, self.outcome.reference)
        )
        return f"{self.plant.number:4} {off} {moved} {far / self.plant.distance_counts:4.0%}"


HEAD = """         off by                                    proposal      examples
   n  accel. damping friction load   delay backl. settles over  settles over   far
           %       %       %    PWM     ms counts      ms            ms        %"""
MUST_SHOW: dict[str, tuple[Callable[[Judged], bool], float]] = {
    "acceleration known within 10 %": (lambda each: each.is_identified, 0.95),
    "stable: settles with the proposal": (lambda each: each.is_stable, 1.0),
    "settles as well as with the gains of the examples": (lambda each: each.settles_as_well, 0.9),
    "overshoot of 15 % at most": (lambda each: not each.overshoots, 1.0),
    "within the stated distance": (lambda each: not each.is_too_far, 1.0),
}


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_sixty_drawn_machines_are_identified_and_tuned():
    print(HEAD)
    judged = []
    for plant in drawn_plants(SEED, PLANTS):
        judged.append(Judged.of(plant))
        print(judged[-1], flush=True)

    shown = {what: (sum(map(judge, judged)), share) for what, (judge, share) in MUST_SHOW.items()}
    print("\n".join(f"{count:3} of {PLANTS}: {what}" for what, (count, _) in shown.items()))

    assert [what for what, (count, share) in shown.items() if count < share * PLANTS] == []


@pytest.mark.soak
@pytest.mark.timeout(600)
@pytest.mark.parametrize(
    ("wrong", "said"),
    [({"motor_reversed": True}, "against an output"), ({"encoder_disconnected": True}, "the encoder counted nothing")],
    ids=["reversed motors", "disconnected encoders"],
)
def test_sixty_machines_that_are_wired_wrongly_stay_within_the_distance(wrong, said):
    far = []
    for plant in drawn_plants(SEED, PLANTS):
        axis = SimulatedAxis(PIC_SERVO_V4, replace(plant, motor=plant.motor.model_copy(update=wrong)))
        try:
            axis.run(Excitation(PIC_SERVO_V4, Bounds(plant.distance_counts)).pulses())
            told = "nothing"
        except DriveFault as fault:
            told = fault.message
        far.append((axis.farthest_counts / plant.distance_counts, plant.number, told))
        print(f"{plant.number:4} {far[-1][0]:4.0%} {told}")

    print(f"at most {max(far)[0]:.0%} of the distance")
    assert [each for each in far if each[0] > 1.0 or said not in each[2]] == []
