"""Former names, until the last importer has moved."""

# ruff: noqa: PLC0414
from ldcnd.model.commands import PlanReply as PlanReply
from ldcnd.model.commands import Preview as Preview

PlanRequest = Preview
