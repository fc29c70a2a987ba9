"""Former names, until the last importer has moved."""

# ruff: noqa: PLC0414
from ldcnd.model.rig_commands import ReadWireLog as ReadWireLog
from ldcnd.model.rig_commands import WireLogReply as WireLogReply

WireLogRequest = ReadWireLog
