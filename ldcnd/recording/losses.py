"""What is missing of a recording, as far as sequence numbers tell."""

from collections import Counter

_NUMBERS = 2**32
"""Recordings carry sequence numbers of 32 bits."""


class Losses:
    """Looks at the sequence number of each value of each key, in the order in which they came.

    What was lost before the first value of a key, or after the last, leaves no gap and is not counted.

    Attributes:
        missing: how many values of each key are missing.
        restarts: how often numbers of a key began anew, because its daemon was restarted.
    """

    def __init__(self) -> None:
        self.missing: Counter[str] = Counter()
        self.restarts = 0
        self._last: dict[str, int] = {}

    def saw(self, key: str, seq: int) -> None:
        """Count what is missing between the value before and this one."""
        last = self._last.get(key)
        self._last[key] = seq
        if last is None:
            return
        step = (seq - last) % _NUMBERS
        if 0 < step < _NUMBERS // 2:
            self.missing[key] += step - 1
        else:
            self.restarts += 1

    def facts(self) -> dict[str, str]:
        """Return what was counted, by name, for a file."""
        gaps = {f"missing {key}": str(count) for key, count in sorted((+self.missing).items())}
        return {"missing": str(self.missing.total()), "restarts": str(self.restarts), **gaps}
