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
        active: signals that are on, whatever their level; None for what has no active level.
        resolved: a counter that was off by 65536 and was corrected by what it said before.
    """

    name: MonitorName
    value: int
    unit: str
    title: str
    high: tuple[str, ...] = ()
    active: tuple[str, ...] | None = None
    resolved: bool = False
