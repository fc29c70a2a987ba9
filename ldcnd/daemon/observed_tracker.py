"""The state of an axis that others move: it follows from readings alone, and so do its ends.

Nothing is latched here that only a command could clear, because such a drive takes none: an alarm is over when the
drive says so.
"""

from ldcnd.daemon.axis_tracker import AxisTracker
from ldcnd.drivers.driver import AxisReading
from ldcnd.exchange import Timing
from ldcnd.model.axes import AxisState, LinkState


class ObservedTracker(AxisTracker):
    """An `AxisTracker` without commands: Disabled, Standstill, moving, ErrorStop as the drive shows them."""

    def observed(self, reading: AxisReading, timing: Timing, now_ns: int) -> None:  # noqa: ARG002 - of the contract
        """Digest a reading."""
        self._misses = 0
        self.link = LinkState.UP
        self._faults(reading.faults, now_ns)
        if not self.active_faults:
            self.first_fault = None
        self._at_rest = abs(reading.velocity_counts_per_s) <= reading.velocity_resolution_counts_per_s
        self.enabled = reading.enabled
        self.state = self._shown(reading)

    def _shown(self, reading: AxisReading) -> AxisState:
        if any(fault.stops for fault in reading.faults):
            return AxisState.ERROR_STOP
        if not reading.enabled:
            return AxisState.DISABLED
        return AxisState.STANDSTILL if self._at_rest else AxisState.DISCRETE_MOTION
