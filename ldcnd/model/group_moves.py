"""Several axes that start together: the payload and the reply of `@cmd/_/move_together`."""

from pydantic import Field

from ldcnd.model.frozen import Frozen
from ldcnd.model.replies import CommandReply
from ldcnd.model.requests import MoveAbsoluteRequest


class AxisMove(MoveAbsoluteRequest):
    """The share of one axis; it can carry a command id of its own."""

    axis: str
    """The axis."""


class MoveTogetherRequest(Frozen):
    """Start absolute moves of the axes of one configured group in the same servo cycle, or none of them."""

    moves: tuple[AxisMove, ...] = Field(min_length=2, max_length=31)
    """Exactly the members of a group, each once."""


class MoveTogetherReply(Frozen):
    """Every drive has proven that it started."""

    replies: tuple[CommandReply, ...]
    """One for each axis, in the order of the request."""
