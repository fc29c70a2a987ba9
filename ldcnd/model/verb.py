"""Former names, until the last importer has moved."""

# ruff: noqa: PLC0414
from ldcnd.model.catalogue import verbs_for
from ldcnd.model.commands import Capability
from ldcnd.model.commands import Verb as Verb

PARAMETER_CAPABILITIES = verbs_for(Capability.PARAMETERS)
TRACE_CAPABILITIES = verbs_for(Capability.TRACES)
