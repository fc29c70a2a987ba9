"""Former names, until the last importer has moved."""

# ruff: noqa: PLC0414
from ldcnd.model.catalogue import PUBLIC_MODELS as PUBLIC_MODELS
from ldcnd.model.frozen import DIALECT as DIALECT
from ldcnd.model.frozen import schema_name as schema_name
from ldcnd.model.frozen import schema_text as schema_text
