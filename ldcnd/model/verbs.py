"""The verbs that are no motion command of one axis: questions about an axis, and what concerns the rig."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

from ldcnd.model.authority import AcquireRequest, HolderList, HoldersRequest, LeaseReply, LeaseRequest
from ldcnd.model.events import CommandOutcome, EventList, EventsRequest, OutcomeRequest
from ldcnd.model.frozen import Frozen
from ldcnd.model.group_moves import MoveTogetherReply, MoveTogetherRequest
from ldcnd.model.preview import PlanReply, PlanRequest
from ldcnd.model.rehearsal import RehearsalReply, RehearsalRequest
from ldcnd.model.why import WhyReply, WhyRequest
from ldcnd.model.wire_log import WireLogReply, WireLogRequest


@dataclass(frozen=True, slots=True)
class VerbModels:
    """What a verb takes and what it answers."""

    request: type[Frozen]
    reply: type[Frozen]


WHY, PLAN = "why", "plan"
AXIS_QUESTIONS: Mapping[str, VerbModels] = MappingProxyType(
    {WHY: VerbModels(WhyRequest, WhyReply), PLAN: VerbModels(PlanRequest, PlanReply)}
)
"""`@cmd/<axis>/<verb>`: has no effect."""

ACQUIRE, RENEW, RELEASE, HOLDERS, OUTCOME, EVENTS = "acquire", "renew", "release", "holders", "outcome", "events"
REHEARSE, MOVE_TOGETHER, WIRE_LOG = "rehearse", "move_together", "wire_log"
RIG_VERBS: Mapping[str, VerbModels] = MappingProxyType(
    {
        ACQUIRE: VerbModels(AcquireRequest, LeaseReply),
        RENEW: VerbModels(LeaseRequest, LeaseReply),
        RELEASE: VerbModels(LeaseRequest, LeaseReply),
        HOLDERS: VerbModels(HoldersRequest, HolderList),
        OUTCOME: VerbModels(OutcomeRequest, CommandOutcome),
        EVENTS: VerbModels(EventsRequest, EventList),
        REHEARSE: VerbModels(RehearsalRequest, RehearsalReply),
        MOVE_TOGETHER: VerbModels(MoveTogetherRequest, MoveTogetherReply),
        WIRE_LOG: VerbModels(WireLogRequest, WireLogReply),
    }
)
"""`@cmd/_/<verb>`."""
