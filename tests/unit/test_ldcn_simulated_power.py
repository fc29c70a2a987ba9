"""The diagnostics table of the LS-182AP manual, row by row, as the simulated drive shows it."""

import pytest

from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn.controls import StopControl
from ldcnd.drives.ldcn.faults import AFTER_RESET, FaultCode, Knowledge, diagnose
from ldcnd.drives.ldcn.packet import AuxFlag, CommandCode, StatusFlag
from ldcnd.drives.ldcn.profiles import LS_182AP
from ldcnd.drives.ldcn.registers import encode_gains
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.power import FaultCondition
from tests.support.simulated_host import SimulatedHost, little

GAINS = Gains(kp=350, kd=3000, ki=400, il=400, ol=250, cl=0, el=4000, sr=1)
CLOSE = StopControl.AMP_ENABLE | StopControl.ABRUPT
OFF = StopControl(0)


class Rig(SimulatedHost):
    def __init__(self):
        super().__init__(build_chain(ChainSpec((ModuleSpec("ls182ap"),))))
        self.address_all()
        self.send(1, CommandCode.SET_GAIN, *encode_gains(LS_182AP, GAINS))

    def stop(self, control):
        self.send(1, CommandCode.STOP_MOTOR, control)

    def clear(self):
        self.send(1, CommandCode.CLEAR_STICKY_BITS)

    def set(self, condition, *, present=True):
        self.chain.modules[0].set_condition(condition, present=present, at_s=self.now_s)

    def status(self):
        return self.read(1, LS_182AP)


def columns(status):
    """Return limit 2, limit 1, pos_error, power_on, servo_on, index as the table has them."""
    bits = (StatusFlag.LIMIT2, StatusFlag.LIMIT1, StatusFlag.POSITION_ERROR, StatusFlag.POWER_ON)
    aux = (AuxFlag.SERVO_ON, AuxFlag.INDEX)
    return [int(bool(status.flags & bit)) for bit in bits] + [int(bool(status.aux & bit)) for bit in aux]


def codes(status, *, pic_ae):
    known = Knowledge(pic_ae=True, absolute=False) if pic_ae else AFTER_RESET
    return [fault.code for fault in diagnose(LS_182AP, status, known)]


def test_healthy_rows():
    rig = Rig()
    off = rig.status()
    rig.stop(CLOSE)
    rig.clear()
    on = rig.status()

    assert columns(off) == [1, 1, 1, 1, 0, 1]
    assert columns(on) == [0, 0, 0, 1, 1, 1]
    assert codes(off, pic_ae=False) == codes(on, pic_ae=True) == []


@pytest.mark.parametrize(
    ("condition", "limit2", "limit1", "power_on", "code"),
    [
        (FaultCondition.OVERHEAT, 0, 1, 1, FaultCode.OVERHEAT),
        (FaultCondition.STOP_INPUT, 1, 0, 1, FaultCode.STOP_INPUT),
        (FaultCondition.OVERVOLTAGE, 1, 1, 0, FaultCode.OVERVOLTAGE),
    ],
)
def test_standing_condition_is_shown_with_the_power_driver_off(condition, limit2, limit1, power_on, code):
    rig = Rig()

    rig.set(condition)
    standing = rig.status()
    rig.set(condition, present=False)

    assert columns(standing) == [limit2, limit1, 1, power_on, 0, 1]
    assert codes(standing, pic_ae=False) == [code]
    assert codes(rig.status(), pic_ae=False) == []


LATCHED_ROWS = [
    (FaultCondition.STOP_INPUT, [1, 0, 1, 0, 0, 1], FaultCode.STOP_INPUT),
    (FaultCondition.MOTOR_SHORT, [0, 1, 1, 0, 0, 1], FaultCode.MOTOR_SHORT_OR_OVERVOLTAGE),
    (FaultCondition.OVERVOLTAGE, [0, 1, 1, 0, 0, 1], FaultCode.MOTOR_SHORT_OR_OVERVOLTAGE),
    (FaultCondition.OVERHEAT, [1, 1, 1, 0, 0, 1], FaultCode.OVERHEAT),
    (FaultCondition.OVERCURRENT, [0, 0, 1, 0, 0, 1], FaultCode.OVERCURRENT),
    (FaultCondition.ENCODER_LOSS, [1, 0, 1, 0, 0, 0], FaultCode.ENCODER_OR_HALL),
]


@pytest.mark.parametrize(("condition", "row", "code"), LATCHED_ROWS)
def test_cause_is_latched_after_it_has_gone(condition, row, code):
    rig = Rig()
    rig.stop(CLOSE)
    rig.clear()

    rig.set(condition)
    rig.set(condition, present=False)
    status = rig.status()

    assert columns(status) == row
    assert codes(status, pic_ae=True) == [code]


@pytest.mark.parametrize(("condition", "row", "code"), LATCHED_ROWS)
def test_only_the_whole_recovery_sequence_restores_operation(condition, row, code):
    rig = Rig()
    rig.stop(CLOSE)
    rig.set(condition)
    rig.set(condition, present=False)

    rig.clear()
    rig.stop(CLOSE)
    without_disabling = columns(rig.status())
    rig.stop(OFF)
    rig.stop(CLOSE)
    without_clearing = columns(rig.status())
    rig.stop(OFF)
    rig.clear()
    recovered = columns(rig.status())
    rig.stop(CLOSE)
    rig.clear()

    assert without_disabling == without_clearing == row
    assert recovered == [1, 1, 1, 1, 0, 1]
    assert columns(rig.status()) == [0, 0, 0, 1, 1, 1]
    assert codes(rig.status(), pic_ae=True) == []


def test_standing_cause_is_latched_again_when_the_power_driver_is_enabled():
    rig = Rig()
    rig.set(FaultCondition.STOP_INPUT)

    rig.stop(CLOSE)
    rig.clear()

    assert columns(rig.status()) == [1, 0, 1, 0, 0, 1]


def test_position_error_keeps_power_on_and_needs_the_recovery_sequence():
    rig = Rig()
    rig.stop(CLOSE)
    rig.clear()
    rig.set(FaultCondition.STALLED)
    rig.send(1, CommandCode.STOP_MOTOR, StopControl.AMP_ENABLE | StopControl.HERE, *little(4001, 4))
    tripped = rig.status()
    rig.set(FaultCondition.STALLED, present=False)
    rig.stop(CLOSE)
    refused = rig.status()
    rig.stop(OFF)
    rig.clear()
    rig.stop(CLOSE)
    rig.clear()

    assert columns(tripped) == [0, 0, 1, 1, 0, 1]
    assert codes(tripped, pic_ae=True) == [FaultCode.POSITION_ERROR]
    assert not refused.aux & AuxFlag.SERVO_ON
    assert columns(rig.status()) == [0, 0, 0, 1, 1, 1]


def test_tripped_drive_lets_the_motor_coast():
    rig = Rig()
    rig.stop(CLOSE)
    rig.send(1, CommandCode.LOAD_TRAJECTORY, 0xB6, *little(8 << 16, 4), *little(2000, 4))
    rig.wait(0.5)

    rig.set(FaultCondition.STOP_INPUT)
    first = rig.status().position
    rig.wait(0.1)

    assert rig.status().position > first
    assert rig.chain.modules[0].loop.pwm == 0
