"""What was on a line lately: the flight recorder as the network sees it."""

from pydantic import Field

from ldcnd.model.frozen import Frozen


class WireLogRequest(Frozen):
    """Ask what was on a line in the last seconds."""

    bus: str
    """Which line."""
    seconds: float = Field(default=10.0, gt=0, le=86_400)
    """How far back, in seconds; what is older than the recorder keeps is gone."""
    from_record: int | None = Field(default=None, ge=0)
    """Go on from this record; null for the first one within `seconds`."""


class WireLogReply(Frozen):
    """Some consecutive records of a line, oldest first: the reply to `@cmd/_/wire_log`."""

    bus: str
    """The line."""
    family: str
    """The drive family on it: how the bytes are to be read."""
    zero: int
    """The wall time at which the records' clock was 0, UTC in ns since 1970."""
    started: float
    """What that clock showed when the daemon was started, in seconds."""
    now: float
    """What that clock showed when this was answered, in seconds."""
    first_record: int = Field(ge=0)
    """Number of the first record in `lines`; records are counted since the daemon started."""
    next_record: int = Field(ge=0)
    """Number of the record behind the last one in `lines`: ask from here for more."""
    end_record: int = Field(ge=0)
    """Number that the next record to happen will get; equal to `next_record` when this reply has all."""
    lines: tuple[str, ...]
    """One record each: seconds, event, bytes in hexadecimal, and perhaps a remark behind a number sign."""
