"""Former names, until the last importer has moved."""

# ruff: noqa: PLC0414
from ldcnd.model.meta import AxisInfo as AxisInfo
from ldcnd.model.meta import AxisLimits as AxisLimits
from ldcnd.model.meta import Provenance as Provenance
from ldcnd.model.meta import RegisterInfo as RegisterInfo
from ldcnd.model.plan import PollPriority as PollPriority
from ldcnd.model.samples import AxisState as AxisState
from ldcnd.model.samples import LinkState as LinkState
from ldcnd.model.samples import Moving as Moving
from ldcnd.model.samples import Quality as Quality
