"""Alarm codes of the present alarm (850AH) and of the history (8500H to 8509H).

Source: manual 3, "Alarm table".
"""

from dataclasses import dataclass
from enum import StrEnum

NO_ALARM = 0x0099
"""Not an alarm: it says that there is none, and is never shown as A.99 (manual 3, note)."""
HISTORY_LENGTH = 10


class AlarmKind(StrEnum):
    """What a code means for the drive."""

    NONE = "none"
    ALARM = "alarm"
    """The drive has stopped; RESET on CN1-18 clears it, no command does."""
    WARNING = "warning"
    """91 and 92: titled alarms in the manual, but related drives go on running (INFERRED_MEDIUM)."""
    UNKNOWN = "unknown"
    """A code that the manual does not list; the number is kept."""


@dataclass(frozen=True, slots=True)
class Alarm:
    """A code and the manual's words for it."""

    code: int
    text: str
    kind: AlarmKind = AlarmKind.ALARM


ALARMS: tuple[Alarm, ...] = (
    Alarm(0x0004, "Parameter setting error"),
    Alarm(0x0010, "Overcurrent"),
    Alarm(0x0030, "Regeneration error"),
    Alarm(0x0032, "Regeneration overload"),
    Alarm(0x0040, "Overvoltage/undervoltage"),
    Alarm(0x0051, "Overspeed"),
    Alarm(0x0070, "Overload"),
    Alarm(0x0073, "Dynamic brake overload"),
    Alarm(0x0074, "Inrush resistance overload"),
    Alarm(0x007A, "Radiator overheating"),
    Alarm(0x00BF, "System error"),
    Alarm(0x00C1, "Runaway detected"),
    Alarm(0x00C2, "Phase error detected"),
    Alarm(0x00C3, "Encoder disconnection detected"),
    Alarm(0x00D0, "Deviation counter over"),
    Alarm(0x0091, "Overload alarm", AlarmKind.WARNING),
    Alarm(0x0092, "Regeneration overload alarm", AlarmKind.WARNING),
    Alarm(NO_ALARM, "Normal (No alarm)", AlarmKind.NONE),
)


def alarm(word: int) -> Alarm:
    """Return what a drive means by an alarm word; a code that is not listed keeps its number."""
    for known in ALARMS:
        if known.code == word:
            return known
    return Alarm(word, f"unlisted alarm code {word:04X}H", AlarmKind.UNKNOWN)
