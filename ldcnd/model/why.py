"""Former names, until the last importer has moved."""

# ruff: noqa: PLC0414
from ldcnd.model.commands import Cause as Cause
from ldcnd.model.commands import Why as Why
from ldcnd.model.commands import WhyReply as WhyReply

WhyRequest = Why
