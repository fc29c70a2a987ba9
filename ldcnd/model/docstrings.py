"""Former names, until the last importer has moved."""

# ruff: noqa: PLC0414
from ldcnd.model.frozen import attribute_docstrings as attribute_docstrings
