"""What may be wrong with a machine that is commissioned or tuned: one sentence for each, and one way to name several.

A trial names one fault only where no other one leads to the same readings. Where several do, it names all of them, and
says that they cannot be told apart.
"""

from collections.abc import Sequence
from enum import StrEnum

from ldcnd.contract.errors import DriveFault


class MachineFault(StrEnum):
    """A fault of a machine, in words; `remedy` says what to do about it."""

    LOAD_HANGS = "a load hangs on it: friction does not hold it when the loop is open"
    CARRIED = "a load carries it off when the loop closes, as behind a brake that opens then"
    REVERSED = "motor and encoder disagree: one of them is reversed"
    NO_COUNTS = "the encoder does not count, or does not reach the drive"
    NO_SUPPLY = "the motor has no supply, or too little"
    MOTOR_WIRES = "a wire of the motor is open"
    BRAKE = "a brake is closed, or something blocks the axis"
    COUPLING = "the coupling between motor and encoder slips or has play"
    AT_END = "it stands at an end of its travel, or something blocks it one way"
    HEAVY = "its load or friction is more than the output that is tried"
    SWITCH_DEAD = "a limit switch is stuck, is not wired to its input, or was not pressed"
    SWITCH_HELD = "the axis stands on a limit switch"
    SWITCHES_SWAPPED = "the limit switches are swapped, or `direction` is wrong"
    SWITCHES_JOINED = "both limit switches act on one input"
    SWITCHES_UNLIKE = "one limit switch opens and the other one closes when it is pressed"

    @property
    def remedy(self) -> str:
        """What to do about it."""
        return REMEDIES[self]


REMEDIES = {
    MachineFault.LOAD_HANGS: "fit a brake that closes without power, or balance or secure the load",
    MachineFault.CARRIED: "let the brake open only by the drive's own output, or secure the load",
    MachineFault.REVERSED: "switch the drive off, and swap the two wires of the motor, or A and B of the encoder",
    MachineFault.NO_COUNTS: "switch the drive off, and check the wires of the encoder",
    MachineFault.NO_SUPPLY: "check the motor's supply, its fuse and its voltage under load",
    MachineFault.MOTOR_WIRES: "switch the drive off, and check the wires of the motor",
    MachineFault.BRAKE: "open the brake, and turn the axis by hand without power",
    MachineFault.COUPLING: "tighten the coupling, and look for play",
    MachineFault.AT_END: "move it by hand to the middle of its travel",
    MachineFault.HEAVY: "turn the axis by hand without power: is it heavy",
    MachineFault.SWITCH_DEAD: "press the switch by hand, and measure at the drive's connector",
    MachineFault.SWITCH_HELD: "move it off its switches by hand",
    MachineFault.SWITCHES_SWAPPED: "exchange the wires of the switches, or correct `direction` first (step scale)",
    MachineFault.SWITCHES_JOINED: "wire each switch to its own input",
    MachineFault.SWITCHES_UNLIKE: "wire both switches alike",
}
STANDS = (
    MachineFault.NO_SUPPLY,
    MachineFault.MOTOR_WIRES,
    MachineFault.BRAKE,
    MachineFault.COUPLING,
    MachineFault.NO_COUNTS,
    MachineFault.HEAVY,
)
"""All of these lead to an encoder that counts nothing, whatever the output."""


def named(faults: Sequence[MachineFault]) -> str:
    """Return one fault with its remedy, or several with the remark that they cannot be told apart."""
    if len(faults) == 1:
        return f"{faults[0]}. To do: {faults[0].remedy}"
    return "it cannot be told from here which of these it is: " + "; ".join(
        f"{number}. {fault} ({fault.remedy})" for number, fault in enumerate(faults, 1)
    )


def fault_found(seen: str, *faults: MachineFault, value: float | None = None) -> DriveFault:
    """Return the error of a trial that has found something wrong.

    Args:
        seen: what was measured.
        faults: what may be wrong.
        value: as measured.
    """
    if len(faults) == 1:
        return DriveFault(f"{seen}: {faults[0]}", value=value, remedy=faults[0].remedy)
    return DriveFault(seen, value=value, remedy=named(faults))
