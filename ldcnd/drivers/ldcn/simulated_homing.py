"""The search for home of a simulated servo drive.

It triggers on a change of an input relative to the moment of arming, or on an event of the servo loop.
Sources: LS-182AP manual and PIC-SERVO manual, "Set Homing Mode".
"""

from dataclasses import dataclass

from ldcnd.drivers.ldcn.controls import HomingControl


@dataclass(frozen=True, slots=True)
class Inputs:
    """The inputs that can capture the home position, as levels."""

    limit1: bool
    limit2: bool
    index: bool


@dataclass(frozen=True, slots=True)
class HomeSearch:
    """One armed search: what it waits for, and how the inputs were when it began."""

    control: HomingControl
    armed_with: Inputs

    def limit_changed(self, inputs: Inputs) -> bool:
        """Tell whether a watched limit switch changed."""
        return bool(
            (self.control & HomingControl.LIMIT1 and inputs.limit1 != self.armed_with.limit1)
            or (self.control & HomingControl.LIMIT2 and inputs.limit2 != self.armed_with.limit2)
        )

    def index_changed(self, inputs: Inputs) -> bool:
        """Tell whether the watched index changed."""
        return bool(self.control & HomingControl.INDEX) and inputs.index != self.armed_with.index
