"""One monitor of a drive, read: what a family hands to the daemon to publish."""

from dataclasses import dataclass

from ldcnd.model.samples import MonitorName


@dataclass(frozen=True, slots=True)
class MonitorValue:
    """One monitor, read.

    Attributes:
        name: which.
        value: in `unit`, with its sign; for signals and switches their documented bits.
        title: the manual's words.
        high: signals at high level, switches that are on.
        resolved: a counter that was off by 65536 and was corrected by what it said before.
    """

    name: MonitorName
    value: int
    unit: str
    title: str
    high: tuple[str, ...] = ()
    resolved: bool = False
