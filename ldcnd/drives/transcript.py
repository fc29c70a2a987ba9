"""Wire records in words: what the transcripts of all families share."""

from collections.abc import Callable

from ldcnd.line.flight_recorder import WireEvent, WireRecord

Describe = Callable[[WireRecord], str]


class Parts:
    """Puts replies together that were delivered in pieces."""

    def __init__(self) -> None:
        self._before = b""

    def whole(self, record: WireRecord) -> bytes:
        """Return the record's bytes behind those of the parts before it; of a part alone, nothing."""
        before, self._before = self._before, b""
        if record.event is WireEvent.PART:
            self._before = before + record.data
            return b""
        return before + record.data if record.event is WireEvent.RECEIVED else record.data
