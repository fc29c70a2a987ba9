"""The control bytes of Stop Motor, Set Homing Mode, I/O Control and Reset Position.

Sources: LS-182AP manual, "Stop Motor", "Set Homing Mode"; PIC-SERVO manual, 5.2 (limit switch pins as outputs: "I/O
Control"); for the motion lock and for Reset Position later vendor data sheets.
"""

from enum import IntEnum, IntFlag

from ldcnd.contract.commands import HomeMethod, PinMode
from ldcnd.contract.errors import NotSupported, ValueOutOfRange
from ldcnd.drives.ldcn.profiles import HomingControl, Profile


class StopControl(IntFlag):
    """Stop Motor; with none of bits 1 to 4 only the amplifier enable changes."""

    AMP_ENABLE = 0x01
    """Called Pic_ae by Logosol: the power driver is on."""
    MOTOR_OFF = 0x02
    """Servo off, PWM 0."""
    ABRUPT = 0x04
    """Servo on, hold the present position at once."""
    SMOOTH = 0x08
    """Decelerate at the loaded acceleration, then hold."""
    HERE = 0x10
    """Go to the given position without a profile."""
    ADVANCED = 0x20
    """Turn on what PIC-SERVO CMC has beyond version 4; PIC-SERVO SC ignores it."""
    LOCK_DISABLE = 0x80
    """Allow motion again after homing on a limit; LS-182AP from version `Profile.motion_lock_from` on."""


class LimitPins(IntFlag):
    """I/O Control of PIC-SERVO version 4: the limit switch pins as outputs."""

    LIMIT1_HIGH = 0x01
    LIMIT2_HIGH = 0x02
    LIMIT1_INPUT = 0x04
    LIMIT2_INPUT = 0x08


class IoOption(IntFlag):
    """I/O Control of PIC-SERVO SC; every command sets or clears all of them."""

    LIMIT_OFF = 0x04
    """Limit protection: a limit switch turns the motor off."""
    LIMIT_STOP = 0x08
    """Limit protection: a limit switch stops the motor abruptly."""
    THREE_PHASE = 0x10
    ANTIPHASE = 0x20
    FAST_PATH = 0x40
    """Path points come at 60 or 120 Hz instead of 30 or 60; PIC-SERVO CMC has this bit, too."""
    STEP_DIRECTION = 0x80


class StartUp(IntFlag):
    """The data byte of Hard Reset on PIC-SERVO SC; without SAVE everything that was saved is erased."""

    SAVE = 0x01
    ADDRESSES = 0x02
    AMPLIFIER_ON = 0x04
    SERVO_ON = 0x08
    STEP_DIRECTION = 0x10
    LIMIT_PROTECTION = 0x20
    THREE_PHASE = 0x40
    ANTIPHASE = 0x80


class PositionReset(IntEnum):
    """Reset Position with data, PIC-SERVO SC only."""

    RELATIVE_TO_HOME = 1
    SET_POSITION = 2


WAYS_TO_STOP = StopControl.MOTOR_OFF | StopControl.ABRUPT | StopControl.SMOOTH | StopControl.HERE
STOPS_ON_HOME = HomingControl.MOTOR_OFF | HomingControl.STOP_ABRUPT | HomingControl.STOP_SMOOTH
ALL_STOP_BITS = WAYS_TO_STOP | StopControl.AMP_ENABLE | StopControl.LOCK_DISABLE
EXCLUSIVE_OPTIONS = (
    IoOption.LIMIT_OFF | IoOption.LIMIT_STOP,
    IoOption.THREE_PHASE | IoOption.ANTIPHASE,
    IoOption.STEP_DIRECTION | IoOption.LIMIT_OFF,
    IoOption.STEP_DIRECTION | IoOption.LIMIT_STOP,
)
"""Pairs that the data sheet of PIC-SERVO SC does not allow together."""


def check_stop(control: StopControl, profile: Profile | None) -> None:
    """Refuse a control byte of Stop Motor that the device does not define; without a profile, one that none defines.

    Raises:
        ValueOutOfRange: more than one way to stop, or a bit that must be clear.
        NotSupported: "stop here" on PIC-SERVO version 1, "lock disable" where there is no lock, the bit for the
            advanced features where there are none.
    """
    # "only one of the bits 1, 2, 3 or 4 should be set at the same time" (both manuals, "Stop Motor")
    if (control & WAYS_TO_STOP).bit_count() > 1:
        raise ValueOutOfRange(f"stop control {int(control):02X}: at most one of bits 1 to 4", value=int(control))
    # "5-7: Clear all to 0" (LS-182AP manual): later devices define 5 and 7
    if control & ~(ALL_STOP_BITS | StopControl.ADVANCED):
        raise ValueOutOfRange(f"stop control {int(control):02X}: bit 6 must be clear", value=int(control))
    if control & StopControl.ADVANCED and not (profile and profile.advanced_stop):
        raise NotSupported(f"{profile.title if profile else 'the group'} has no advanced features to turn on")
    if profile and control & StopControl.HERE and not profile.stop_here:
        raise NotSupported(f"{profile.title} cannot stop at a given position")
    if control & StopControl.LOCK_DISABLE and not (profile and profile.motion_lock_from is not None):
        raise NotSupported(f"{profile.title if profile else 'the group'} has no motion lock")


def check_homing(control: HomingControl, profile: Profile | None) -> None:
    """Refuse a control byte of Set Homing that the device does not define; without a profile, one that none defines.

    Raises:
        ValueOutOfRange: more than one way to stop, or a stop without a source that would trigger it.
        NotSupported: a source or the stop on home does not exist on this device.
    """
    stops = control & STOPS_ON_HOME
    sources = control & ~STOPS_ON_HOME
    # "one (and only one) of bits 2, 4 or 5" (both manuals, "Set Homing Mode")
    if stops.bit_count() > 1:
        raise ValueOutOfRange(f"homing control {int(control):02X}: at most one of bits 2, 4, 5", value=int(control))
    if stops and not sources:
        raise ValueOutOfRange(f"homing control {int(control):02X}: nothing triggers the stop", value=int(control))
    if profile is None:
        return
    if sources & ~profile.homing_sources:
        raise NotSupported(f"{profile.title} cannot capture home on {sources & ~profile.homing_sources!r}")
    if stops and not profile.stops_on_home:
        raise NotSupported(f"{profile.title} does not stop on home by itself")


def pin_bits(mode: PinMode, is_input: LimitPins, is_high: LimitPins) -> LimitPins:
    """Return the bits of I/O Control that use a pin so, given those of an input and of an output that is high."""
    return {PinMode.INPUT: is_input, PinMode.HIGH: is_high, PinMode.LOW: LimitPins(0)}[mode]


def blocking_pin(method: HomeMethod) -> str:
    """Return the register of the pin that must be an input for a capture; empty where none need be."""
    return {HomeMethod.REVERSE_LIMIT: "limit1_pin", HomeMethod.FORWARD_LIMIT: "limit2_pin"}.get(method, "")
