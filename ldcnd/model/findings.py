"""Former names, until the last importer has moved."""

# ruff: noqa: PLC0414
from ldcnd.model.health import Finding as Finding
from ldcnd.model.health import Verdict as Verdict
