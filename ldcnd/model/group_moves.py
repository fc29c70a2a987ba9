"""Former names, until the last importer has moved."""

# ruff: noqa: PLC0414
from ldcnd.model.rig_commands import AxisMove as AxisMove
from ldcnd.model.rig_commands import MoveTogether as MoveTogether
from ldcnd.model.rig_commands import MoveTogetherReply as MoveTogetherReply

MoveTogetherRequest = MoveTogether
