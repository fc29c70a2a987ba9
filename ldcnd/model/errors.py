"""Former names, until the last importer has moved."""

# ruff: noqa: PLC0414
from ldcnd.model.commands import ErrorReply as ErrorReply
from ldcnd.model.commands import ReceivedError as ReceivedError
