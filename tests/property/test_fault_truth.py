"""What is said of a drive against what the simulated drive knows, over random histories of what it was told and shown.

A history trips the drive, stops it, switches it on and off, resets it, loses packets and replies, pulls the cable, and
lets another daemon take the drive over. After each step a reading is digested as the daemon does it: no cause may be
named that the drive does not have, and no axis may count as referenced while the drive holds a cause that loses the
position.
"""

import random

import pytest

from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.faults import WARNINGS, FaultCode
from ldcnd.drives.ldcn.record import DriveState
from ldcnd.drives.ldcn.registers import ServoRegisters
from ldcnd.line.exchange import Timing
from ldcnd.sim.ldcn.power import FaultCondition, LogosolPower, Trip
from tests.support.axis_bench import put, tracked
from tests.support.simulated_axis import ON, ONE, SimulatedAxis

STEPS = 25
LATCHED = {
    Trip.STOP_INPUT: FaultCode.STOP_INPUT,
    Trip.SHORT_OR_OVERVOLTAGE: FaultCode.MOTOR_SHORT_OR_OVERVOLTAGE,
    Trip.OVERHEAT: FaultCode.OVERHEAT,
    Trip.OVERCURRENT: FaultCode.OVERCURRENT,
    Trip.ENCODER: FaultCode.ENCODER_OR_HALL,
    Trip.POSITION_ERROR: FaultCode.POSITION_ERROR,
    Trip.SENSOR: FaultCode.SENSOR_FAULT,
}
PRESENT = {
    FaultCondition.STOP_INPUT: FaultCode.STOP_INPUT,
    FaultCondition.OVERHEAT: FaultCode.OVERHEAT,
    FaultCondition.OVERVOLTAGE: FaultCode.OVERVOLTAGE,
}
LOGOSOL_CONDITIONS = (*PRESENT, FaultCondition.MOTOR_SHORT, FaultCondition.OVERCURRENT, FaultCondition.ENCODER_LOSS)


class History:
    """One drive, what its host remembers of it, and what the daemon makes of that."""

    def __init__(self, model: str, seed: int) -> None:
        self.dice = random.Random(seed)
        self.axis = SimulatedAxis(model, closed=False)
        self.story: list[str] = []
        self.opened_by: set[FaultCode] = set()  # PIC-SERVO: what opened the loop or kept it open
        self.known = self.tracker = None
        self._new_daemon()
        self.known.restarted()

    def _new_daemon(self) -> None:
        self.known = DriveState("x", self.axis.profile, ServoRegisters(self.axis.profile, None, lambda: 0.0))
        self.tracker = tracked()

    @property
    def stage(self):
        return self.axis.drive.stage

    def step(self) -> None:
        """Do something at random, then read the drive and hold what is said of it against the truth."""
        steps = (self.switch_on, self.switch_off, self.reset, self.suffer, self.recover, self.jam, self.cut, self.adopt)
        step = self.dice.choice(steps)
        self.story.append(step.__name__)
        step()
        self.read()

    # -- what a host does --------------------------------------------------------------------------------------------

    def stop_motor(self, control: StopControl) -> bool:
        """Send Stop Motor; the packet or the reply may be lost."""
        arrives, answered = self.dice.random() < 0.9, self.dice.random() < 0.9
        if arrives:
            self.axis.stop(control)
        if not (arrives and answered):
            self.known.switched_unconfirmed(pic_ae=bool(control & ON), closed=not control & StopControl.MOTOR_OFF)
            self.story[-1] += "?"
            return False
        self.known.switched(pic_ae=bool(control & ON), closed=not control & StopControl.MOTOR_OFF)
        return True

    def clear(self) -> None:
        arrives, answered = self.dice.random() < 0.9, self.dice.random() < 0.9
        self.known.clearing()
        if arrives:
            self.axis.clear()
            self.opened_by = set()
        if arrives and answered:
            self.known.cleared()
        else:
            self.story[-1] += "?"

    def switch_on(self) -> None:
        if self.known.known.latched is None and self.stop_motor(ON | StopControl.ABRUPT):
            self.clear()

    def switch_off(self) -> None:
        self.stop_motor(StopControl.MOTOR_OFF)

    def reset(self) -> None:
        if self.stop_motor(StopControl.MOTOR_OFF):
            self.clear()

    def cut(self) -> None:
        """Pull the cable, let things happen, and put it back."""
        for _ in range(self.dice.randrange(3)):
            self.dice.choice((self.suffer, self.recover))()
        self.known.unseen()

    def adopt(self) -> None:
        self._new_daemon()
        self.known.taken_over(self.axis.status())

    # -- what befalls the drive --------------------------------------------------------------------------------------

    def suffer(self) -> None:
        self.axis.suffer(self.dice.choice(self.conditions))
        self.axis.wait(0.01)

    def recover(self) -> None:
        for condition in self.conditions:
            self.axis.recover(condition)
        self.axis.wait(0.01)

    def jam(self) -> None:
        """Hold the shaft while the motor turns: a position error."""
        if not self.axis.drive.loop.servo_on:
            return
        self.axis.suffer(FaultCondition.STALLED)
        self.axis.jog(40 * ONE, acceleration=ONE)
        self.axis.wait(0.15)
        self.axis.recover(FaultCondition.STALLED)
        self.axis.wait(0.01)

    @property
    def conditions(self):
        return LOGOSOL_CONDITIONS if isinstance(self.stage, LogosolPower) else (FaultCondition.MOTOR_POWER_OFF,)

    # -- what is said, and what is true ------------------------------------------------------------------------------

    def read(self) -> None:
        reading = self.known.reading(self.axis.status())
        now_s = self.axis.now_s
        self.tracker.observe(reading, Timing(now_s, now_s, now_s, now_s), 0)
        named = {fault.code for fault in reading.faults} - WARNINGS - {FaultCode.LATCHED_FAULT}
        assert named <= self.true_causes(), self.story
        if isinstance(self.stage, LogosolPower) and self.stage.latched is Trip.ENCODER:
            assert not self.tracker.status.referenced, self.story
            assert self.tracker.status.position_lost, self.story
        if not self.tracker.status.position_lost:
            put(self.tracker, referenced=True)  # as set_position would have it, which is admitted now

    def true_causes(self) -> set[str]:
        stage = self.stage
        if isinstance(stage, LogosolPower):
            causes = {LATCHED[stage.latched]} if stage.latched else set()
            if not stage.enabled:
                causes |= {code for condition, code in PRESENT.items() if condition in stage.conditions}
            return causes
        off = FaultCondition.MOTOR_POWER_OFF in stage.conditions
        step = self.story[-1].rstrip("?")
        if self.axis.drive.loop.servo_on:
            self.opened_by = set()
        if off and step in ("suffer", "cut", "switch_on"):  # without power a loop that is told to close stays open
            self.opened_by.add(FaultCode.POWER_LOST)
        if step == "jam" and not off:
            self.opened_by.add(FaultCode.POSITION_ERROR)
        causes = {FaultCode.POWER_LOST} if off else set()
        return causes | self.opened_by


def play(model: str, seed: int) -> None:
    history = History(model, seed)
    for _ in range(STEPS):
        history.step()


@pytest.mark.parametrize("seed", range(30))
@pytest.mark.sweep(5)
def test_no_cause_is_named_that_the_drive_does_not_have(seed):
    for number in range(10):
        play("ls182ap" if number else "picservo-v4", seed * 10 + number)


@pytest.mark.soak
@pytest.mark.parametrize("seed", range(100))
def test_no_cause_is_named_in_ten_thousand_histories(seed):
    for number in range(100):
        play("ls182ap" if number % 5 else "picservo-v4", 1000 + seed * 100 + number)
