"""Rehearsing a loss: what `ldcnd drill` asks of the daemon."""

from enum import StrEnum

from ldcnd.model.frozen import Frozen


class Rehearsal(StrEnum):
    """Who is to disappear."""

    DAEMON_STOP = "daemon_stop"
    """Do to the axis what its policy says for the end of the daemon, without ending."""
    BUS_LOSS = "bus_loss"
    """Drop the axis's line and open it again."""


class RehearsalRequest(Frozen):
    """Rehearse a loss on one axis."""

    kind: Rehearsal
    """Who is to disappear."""
    axis: str
    """Whose policy is rehearsed; a lost line concerns all axes on it."""


class RehearsalReply(Frozen):
    """The loss was played: the reply to `@cmd/_/rehearse`."""

    kind: Rehearsal
    """Who disappeared."""
    axis: str
    """The axis."""
    policy: str
    """What its configuration says for this loss."""
