"""Former names, until the last importer has moved."""

# ruff: noqa: PLC0414
from ldcnd.model.rig_commands import Rehearsal as Rehearsal
from ldcnd.model.rig_commands import RehearsalReply as RehearsalReply
from ldcnd.model.rig_commands import Rehearse as Rehearse

RehearsalRequest = Rehearse
