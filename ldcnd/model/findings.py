"""What an examination of a line has found."""

from enum import StrEnum

from ldcnd.model.frozen import Frozen


class Verdict(StrEnum):
    """What a finding means."""

    FINE = "fine"
    LOOK = "look"
    """Nothing is wrong for certain, but it deserves a look."""
    WRONG = "wrong"
    """It must be put right before the line is used."""


class Finding(Frozen):
    """One thing that was examined."""

    axis: str
    """The drive."""
    what: str
    """What was examined."""
    verdict: Verdict
    """What the result means."""
    text: str
    """The result, for a person."""
    settles: str | None = None
    """The doubt of the drive's profile that it says something about."""
