"""Former names, until the last importer has moved."""

# ruff: noqa: PLC0414
from ldcnd.model.rig_commands import SHORTEST_LEASE_S as SHORTEST_LEASE_S
from ldcnd.model.rig_commands import Acquire as Acquire
from ldcnd.model.rig_commands import Holder as Holder
from ldcnd.model.rig_commands import HolderList as HolderList
from ldcnd.model.rig_commands import LeaseReply as LeaseReply
from ldcnd.model.rig_commands import LeaseRequest as LeaseRequest
from ldcnd.model.rig_commands import ListHolders as ListHolders

AcquireRequest = Acquire
HoldersRequest = ListHolders
