"""When a trace by the host begins to count: a level or an edge on one channel. Pure."""

from ldcnd.model.traces import TraceTrigger, TriggerKind

SIGNAL_LEVEL = 0.5
"""Between the two values of a signal."""


class TriggerWatch:
    """Sees every sample of the watched channel in turn."""

    def __init__(self, trigger: TraceTrigger, *, signal: bool) -> None:
        self._kind = trigger.kind
        self._level = SIGNAL_LEVEL if signal else trigger.level
        self._was_above: bool | None = None  # of the last sample that had a value

    def fires(self, value: float | None, *, ready: bool) -> bool:
        """Take the next sample and tell whether the trigger fires on it.

        Args:
            value: of the channel; None where the drive did not say, which never fires.
            ready: enough samples precede it; what comes earlier is passed over.
        """
        if value is None:
            return False
        above = value >= self._level
        before, self._was_above = self._was_above, above
        rose, fell = before is False and above, before is True and not above
        match self._kind:
            case TriggerKind.RISING:
                met = rose
            case TriggerKind.FALLING:
                met = fell
            case TriggerKind.EITHER:
                met = rose or fell
            case TriggerKind.ABOVE:
                met = above
            case TriggerKind.BELOW:
                met = not above
        return ready and met
