"""The echo of a two-wire adapter: our own bytes, which come back before the reply."""


class Echo:
    """What was sent and has not come back yet."""

    __slots__ = ("_due",)

    def __init__(self) -> None:
        self._due = bytearray()

    def __bool__(self) -> bool:
        """Tell whether bytes of ours are still to come back."""
        return bool(self._due)

    def sent(self, data: bytes) -> None:
        """Expect these bytes back."""
        self._due += data

    def strip(self, data: bytes) -> tuple[bytes, bytes] | None:
        """Take our own bytes off the front, by count: a reply may look exactly like its request.

        Returns:
            The echo and what follows it; None when what came is not what was sent: nothing is expected back any more.
        """
        count = min(len(data), len(self._due))
        if data[:count] != self._due[:count]:
            self._due.clear()
            return None
        del self._due[:count]
        return data[:count], data[count:]

    def clear(self) -> None:
        """Expect nothing back any more."""
        self._due.clear()
