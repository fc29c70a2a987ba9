"""Former names, until the last importer has moved."""

# ruff: noqa: PLC0414
from ldcnd.model.commands import CommandReply as CommandReply
from ldcnd.model.commands import StopReply as StopReply
