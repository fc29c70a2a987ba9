"""Queries that concern the rig as a whole: leases, outcomes, events, wire logs. None of them moves anything."""

from collections.abc import Callable, Mapping

from ldcnd.daemon.authority import Authority, Lease
from ldcnd.daemon.clock import Clock
from ldcnd.daemon.event_log import EventLog
from ldcnd.daemon.journal import Journal
from ldcnd.daemon.ledger import Ledger
from ldcnd.daemon.rig import Rig
from ldcnd.daemon.wire_dumps import wire_page
from ldcnd.errors import UnknownVerb
from ldcnd.log import get_logger
from ldcnd.messaging.codec import decode
from ldcnd.messaging.keys import RIG_ITSELF
from ldcnd.model import verbs
from ldcnd.model.authority import AcquireRequest, Holder, HolderList, HoldersRequest, LeaseReply, LeaseRequest
from ldcnd.model.events import CommandOutcome, EventList, EventsRequest, OutcomeRequest
from ldcnd.model.frozen import Frozen
from ldcnd.model.wire_log import WireLogReply, WireLogRequest

log = get_logger("authority")


class RigDesk:
    """Answers the queries on `@cmd/_/<verb>`."""

    def __init__(self, rig: Rig, authority: Authority, ledger: Ledger, events: EventLog, clock: Clock) -> None:
        self._rig = rig
        self._authority = authority
        self._ledger = ledger
        self._events = events
        self._clock = clock
        self._journal = Journal(rig)
        self._handlers: Mapping[str, Callable[[bytes, str], Frozen]] = {
            verbs.ACQUIRE: self._acquire,
            verbs.RENEW: self._renew,
            verbs.RELEASE: self._release,
            verbs.HOLDERS: self._holders,
            verbs.OUTCOME: self._outcome,
            verbs.EVENTS: self._latest,
            verbs.WIRE_LOG: self._wire_log,
        }

    def answer(self, verb: str, payload: bytes, encoding: str) -> Frozen:
        """Carry out one verb.

        Raises:
            UnknownVerb: there is none of that name.
            RequestRefused: as the verb says.
        """
        handler = self._handlers.get(verb)
        if handler is None:
            raise UnknownVerb(f"the rig has no command {verb!r}; it has {', '.join(verbs.RIG_VERBS)}", value=verb)
        return handler(payload, encoding)

    def _acquire(self, payload: bytes, encoding: str) -> LeaseReply:
        request = decode(AcquireRequest, payload, encoding)
        lease, displaced = self._authority.acquire(
            request.client, self._rig.members(request.axes), request.lease_s, self._clock.now_s(), force=request.force
        )
        for other in displaced:
            if other.client != lease.client:
                log.warning("control taken over", axes=sorted(other.axes), from_client=other.client, by=lease.client)
        self._journal.asked(RIG_ITSELF, verbs.ACQUIRE, request, lease.token)
        log.info("control acquired", client=lease.client, axes=sorted(lease.axes))
        return _reply(lease)

    def _renew(self, payload: bytes, encoding: str) -> LeaseReply:
        request = decode(LeaseRequest, payload, encoding)
        self._journal.asked(RIG_ITSELF, verbs.RENEW, request)
        return _reply(self._authority.renew(request.lease, self._clock.now_s()))

    def _release(self, payload: bytes, encoding: str) -> LeaseReply:
        request = decode(LeaseRequest, payload, encoding)
        self._journal.asked(RIG_ITSELF, verbs.RELEASE, request)
        lease = self._authority.release(request.lease, self._clock.now_s())
        log.info("control released", client=lease.client, axes=sorted(lease.axes))
        return _reply(lease)

    def _holders(self, payload: bytes, encoding: str) -> HolderList:
        decode(HoldersRequest, payload, encoding)
        holders = [(axis, self._authority.holder(axis)) for axis in self._rig.axes]
        return HolderList(
            required=self._authority.required,
            holders=tuple(Holder(axis=axis, client=lease.client if lease else None) for axis, lease in holders),
        )

    def _outcome(self, payload: bytes, encoding: str) -> CommandOutcome:
        entry = self._ledger.get(decode(OutcomeRequest, payload, encoding).command_id)
        return CommandOutcome(
            command_id=entry.command_id,
            axis=entry.axis,
            verb=entry.verb.value,
            status=entry.status,
            reason=entry.reason,
        )

    def _latest(self, payload: bytes, encoding: str) -> EventList:
        return self._events.page(decode(EventsRequest, payload, encoding))

    def _wire_log(self, payload: bytes, encoding: str) -> WireLogReply:
        return wire_page(self._rig, decode(WireLogRequest, payload, encoding), self._clock)


def _reply(lease: Lease) -> LeaseReply:
    return LeaseReply(lease=lease.token, client=lease.client, axes=tuple(sorted(lease.axes)), lease_s=lease.duration_s)
