"""JSON Schemas of the public models."""

import json
import re
from functools import cache

from ldcnd.model.authority import AcquireRequest, HolderList, HoldersRequest, LeaseReply, LeaseRequest
from ldcnd.model.axes import AxisInfo
from ldcnd.model.errors import ErrorReply
from ldcnd.model.events import CommandEvent, CommandOutcome, EventList, EventsRequest, OutcomeRequest
from ldcnd.model.frozen import Frozen
from ldcnd.model.group_moves import MoveTogetherReply, MoveTogetherRequest
from ldcnd.model.health import BusHealth, DaemonHealth
from ldcnd.model.meta import BusInfo, CommandList, DaemonInfo
from ldcnd.model.monitors import MonitorSample
from ldcnd.model.plan import RigPlan
from ldcnd.model.preview import PlanReply, PlanRequest
from ldcnd.model.rehearsal import RehearsalReply, RehearsalRequest
from ldcnd.model.replies import CommandReply, StopReply
from ldcnd.model.requests import REPLY_MODELS, REQUEST_MODELS
from ldcnd.model.samples import SAMPLE_MODELS
from ldcnd.model.traces import TraceChunk, TraceHeader
from ldcnd.model.why import WhyReply, WhyRequest
from ldcnd.model.wire_log import WireLogReply, WireLogRequest

DIALECT = "https://json-schema.org/draft/2020-12/schema"


@cache
def schema_name(model: type[Frozen]) -> str:
    """Return the model's name as it appears in keys and file names: snake_case."""
    return re.sub(r"(?<!^)(?=[A-Z])", "_", model.__name__).lower()


PUBLIC_MODELS: tuple[type[Frozen], ...] = (
    AcquireRequest,
    CommandEvent,
    CommandOutcome,
    EventList,
    EventsRequest,
    HolderList,
    HoldersRequest,
    LeaseReply,
    LeaseRequest,
    MoveTogetherReply,
    MoveTogetherRequest,
    OutcomeRequest,
    PlanReply,
    PlanRequest,
    RehearsalReply,
    RehearsalRequest,
    WhyReply,
    WhyRequest,
    WireLogReply,
    WireLogRequest,
    AxisInfo,
    BusHealth,
    BusInfo,
    CommandList,
    CommandReply,
    DaemonHealth,
    DaemonInfo,
    ErrorReply,
    RigPlan,
    StopReply,
    MonitorSample,
    TraceChunk,
    TraceHeader,
    *REPLY_MODELS.values(),
    *SAMPLE_MODELS.values(),
    *REQUEST_MODELS.values(),
)
"""Everything that crosses the network but the configuration, which is no part of the vocabulary."""


def schema_text(model: type[Frozen]) -> str:
    """Return the model's JSON Schema as stable text with a final newline."""
    schema = {"$schema": DIALECT, **model.model_json_schema(mode="serialization")}
    return json.dumps(schema, indent=2, sort_keys=True) + "\n"
