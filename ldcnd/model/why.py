"""Why an axis cannot move now, and what would clear it."""

from ldcnd.model.frozen import Frozen


class Cause(Frozen):
    """One thing that forbids a motion."""

    code: str
    """The error code that a motion would be refused with."""
    text: str
    """What is in the way."""
    remedy: str | None
    """The command, or the hand, that clears it."""
    page: str | None = None
    """Where its page is, below a console or the documentation."""


class WhyReply(Frozen):
    """The causal chain: the reply to `@cmd/<axis>/why`."""

    axis: str
    """The axis."""
    can_move: bool
    """Whether a motion within the limits would be accepted from the one who asks."""
    causes: tuple[Cause, ...]
    """What is in the way, in the order in which it has to be cleared."""
    first_fault: str | None
    """What went wrong first, if anything did since the last reset."""


class WhyRequest(Frozen):
    """Ask why an axis cannot move."""

    lease: str | None = None
    """The lease under which the motion would be sent."""
    absolute: bool = True
    """Whether the motion would name a position, which needs a referenced axis."""
