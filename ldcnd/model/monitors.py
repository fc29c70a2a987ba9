"""Former names, until the last importer has moved."""

# ruff: noqa: PLC0414
from ldcnd.model.samples import MonitorName as MonitorName
from ldcnd.model.samples import MonitorSample as MonitorSample
