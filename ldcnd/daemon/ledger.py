"""The outcome of every command: an id is carried out at most once, always answered alike, and published as events.

Two memories, because an answer is large and an id is small. Of each sender the latest commands are kept whole, with
their answers; other senders' traffic never evicts them. Of every id that a sender chose, a fingerprint is kept for
`REPLAYED_WITHIN_S`: a command that comes again after its answer was evicted is refused. Commands that carry a lease
and a sequence need no fingerprint: an old sequence is refused while the lease is valid, and the lease afterwards.
"""

import asyncio
import hashlib
import math
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from itertools import count

from ldcnd.axis.clock import Clock
from ldcnd.axis.readings import Arrival
from ldcnd.axis.status import CommandEnd
from ldcnd.contract.codec import to_json
from ldcnd.contract.commands import REPLAYED_WITHIN_S, AxisCommand, Capability, CommandReply, Effect, Power, Verb
from ldcnd.contract.errors import (
    CommandAborted,
    CommandIdReused,
    LdcndError,
    OutcomeUnknown,
    Remedy,
    RequestRefused,
    SessionError,
    TooManyRequests,
    UnknownCommand,
    step,
)
from ldcnd.contract.events import FINAL, CommandEvent, CommandStatus, EventList, ReadEvents
from ldcnd.daemon.link_events import Note
from ldcnd.log import LogLimit, get_logger
from ldcnd.net.publisher import Publisher

ANSWERS_PER_SENDER = 512
"""Final commands of one sender whose answers are kept; those that are not final are never evicted."""
SENDERS = 64
"""Senders whose answers are kept; beyond this, those of the sender that was silent longest are evicted."""
LARGEST_MEMORY = 250_000
"""Maximum number of ids kept; when they all fall within `REPLAYED_WITHIN_S`, further ones are refused."""
RESTING = "\0rest"
"""Commands that bring an axis to rest are carried out at every request; their entries are kept separately."""


@dataclass(frozen=True, slots=True)
class LedgerEntry:
    """One command.

    Attributes:
        command: the request; a repetition must be equal.
        client: the requester, as far as that is known.
        login: whose link it came over, if that has a certificate.
        status: how far it has got.
        reason: why it did not end as requested.
        answer: the reply to the caller, once sent.
        arrival: where its motion has ended.
        target: where it is to come to rest, in axis units; None where that is not known, or it has none.
    """

    command_id: str
    axis: str
    command: AxisCommand[CommandReply]
    client: str | None
    login: str | None = None
    status: CommandStatus = CommandStatus.ACCEPTED
    reason: str | None = None
    answer: CommandReply | LdcndError | None = None
    arrival: Arrival | None = None
    target: float | None = None

    @property
    def verb(self) -> Verb:
        """The verb of the command."""
        return self.command.verb


class Ledger:
    """The commands of one rig, latest last."""

    def __init__(
        self,
        changed: Callable[[LedgerEntry, LdcndError | None], None],
        now_s: Callable[[], float],
        is_reserved: Callable[[str], bool] = lambda _: False,
    ) -> None:
        """Begin empty.

        Args:
            changed: called with every entry and every change of status, and the error that goes with it.
            now_s: returns the time, in seconds.
            is_reserved: tells whether an id is for commands that come without one.
        """
        self._entries: dict[str, LedgerEntry] = {}
        self._of_senders: OrderedDict[str, OrderedDict[str, None]] = OrderedDict()
        self._until_s: dict[int, float] = {}  # by fingerprint, in the order of expiry
        self._changed = changed
        self._now_s = now_s
        self._is_reserved = is_reserved

    def is_taken(self, command_id: str | None) -> bool:
        """Tell whether the id that a sender chose, if it did, names another command already, or has, or may."""
        return command_id is not None and (
            command_id in self._entries or self._is_remembered(command_id) or self._is_reserved(command_id)
        )

    def _is_remembered(self, command_id: str) -> bool:
        return self._until_s.get(_fingerprint(command_id), -math.inf) > self._now_s()

    def repeated(self, command_id: str | None, axis: str, command: AxisCommand[CommandReply]) -> LedgerEntry | None:
        """Return the entry that the id which a sender chose has already; None when it is new, or the sender chose none.

        Raises:
            CommandIdReused: the id belongs to another command, to one whose answer was evicted, or to the daemon.
        """
        if command_id is None:
            return None
        entry = self._entries.get(command_id)
        if entry is None and (self._is_remembered(command_id) or self._is_reserved(command_id)):
            own = "is one of those that the daemon gives" if self._is_reserved(command_id) else "was taken before"
            raise CommandIdReused(
                f"command id {command_id!r} {own}, its answer is not kept; it is not carried out again",
                axis=axis,
                value=command_id,
                remedy=Remedy("{}; give every command an id of its own", step("events", "look at the events")),
            )
        if entry and (entry.axis, entry.verb, _content(entry.command)) != (axis, command.verb, _content(command)):
            raise CommandIdReused(
                f"command id {command_id!r} belongs to {entry.verb} of axis {entry.axis}",
                axis=axis,
                value=command_id,
                remedy="give every command an id of its own",
            )
        return entry

    def get(self, command_id: str) -> LedgerEntry:
        """Return an entry.

        Raises:
            UnknownCommand: there is none, or it was evicted.
        """
        entry = self._entries.get(command_id)
        if entry is None:
            raise UnknownCommand(
                f"no command {command_id!r} is known: the daemon was started again since it was sent, or has taken it"
                " too long ago, or never",
                value=command_id,
                remedy=Remedy("{}", step("events", "look at the events")),
            )
        return entry

    def open(self, entry: LedgerEntry) -> None:
        """Enter a new command.

        Raises:
            TooManyRequests: it has an id of its own, and there is no room to remember that.
        """
        # first: what cannot be remembered is refused before anything of it exists
        self._remember(entry)
        self._entries[entry.command_id] = entry
        # by its login where it has one: any client may call itself by the name of another
        sender = RESTING if entry.command.takes_energy_out else entry.login or entry.client or ""
        entries = self._of_senders.setdefault(sender, OrderedDict())
        self._of_senders.move_to_end(sender)
        entries[entry.command_id] = None
        if len(entries) > ANSWERS_PER_SENDER:
            self._forget_one(entries)
        if len(self._of_senders) > SENDERS:
            self._forget_sender()
        self._changed(entry, None)

    def waits(self, command_id: str, ahead: str) -> CommandReply:
        """Record that a command waits for another one, and return the reply that says so."""
        entry = self._entries[command_id]
        reply = CommandReply(command_id=command_id, axis=entry.axis, verb=entry.verb, waits_for=ahead)
        self._entries[command_id] = replace(entry, answer=reply)
        return reply

    def answered(
        self, command_id: str, answer: CommandReply | LdcndError, status: CommandStatus, target: float | None = None
    ) -> None:
        """Record the reply to the caller, and where the motion is to come to rest that has begun."""
        entry = self._entries.get(command_id)
        if entry is None:
            return
        error = answer if isinstance(answer, LdcndError) else None
        reason = error.message if error else _changed_by(entry.command) if status is CommandStatus.DONE else None
        self._reached(entry, answer, status, reason, error, target=target)

    def ended(self, end: CommandEnd, arrival: Arrival | None) -> None:
        """Take from an axis that a command is over; a final status is kept."""
        if entry := self._entries.get(end.command.command_id):
            status, other = end.status, self._entries.get(end.by[1]) if end.by else None
            reason = end.told(other.client or other.login if other else None)
            if status is CommandStatus.DONE and isinstance(entry.answer, CommandReply) and entry.answer.ends:
                reason = f"came to its own end: it {entry.answer.ends}"
            self._reached(entry, entry.answer, status, reason, None, arrival, end.command.goal)

    def _reached(
        self,
        entry: LedgerEntry,
        answer: CommandReply | LdcndError | None,
        status: CommandStatus,
        reason: str | None,
        error: LdcndError | None,
        arrival: Arrival | None = None,
        target: float | None = None,
    ) -> None:
        news = entry.status not in FINAL and entry.status is not status
        if not news:
            status, reason, arrival = entry.status, entry.reason, entry.arrival
        # spelled out, because `replace` takes 2.0 us instead of 1.3 where the answer waits
        entry = self._entries[entry.command_id] = LedgerEntry(
            command_id=entry.command_id,
            axis=entry.axis,
            command=entry.command,
            client=entry.client,
            login=entry.login,
            status=status,
            reason=reason,
            answer=answer,
            arrival=arrival,
            target=entry.target if target is None else target,
        )
        if news:
            self._changed(entry, error)

    def _remember(self, entry: LedgerEntry) -> None:
        command = entry.command
        if command.command_id is None or command.takes_energy_out:
            return
        if command.lease is not None and command.sequence is not None:
            return
        now_s = self._now_s()
        # all live equally long, so the first to be entered is the first to expire
        while self._until_s and next(iter(self._until_s.values())) <= now_s:
            del self._until_s[next(iter(self._until_s))]
        if len(self._until_s) >= LARGEST_MEMORY:
            raise TooManyRequests(
                f"axis {entry.axis}: {LARGEST_MEMORY} command ids within {REPLAYED_WITHIN_S:g} s are more than can be"
                " remembered",
                axis=entry.axis,
                limit=LARGEST_MEMORY,
                remedy="send commands under a lease with a sequence, or without an id of their own",
            )
        self._until_s[_fingerprint(command.command_id)] = now_s + REPLAYED_WITHIN_S

    def _forget_one(self, entries: OrderedDict[str, None]) -> None:
        for command_id in entries:
            if self._entries[command_id].status in FINAL:
                del entries[command_id], self._entries[command_id]
                return

    def _forget_sender(self) -> None:
        """Evict the answers of the sender that was silent longest, except for commands under way."""
        for sender, entries in self._of_senders.items():
            if all(self._entries[command_id].status in FINAL for command_id in entries):
                for command_id in entries:
                    del self._entries[command_id]
                del self._of_senders[sender]
                return


def status_of(error: LdcndError) -> CommandStatus:
    """Return what became of a command that ended with an error."""
    match error:
        case OutcomeUnknown():
            return CommandStatus.UNKNOWN
        case CommandAborted():
            return CommandStatus.ABORTED
        case RequestRefused():
            return CommandStatus.REFUSED
        case _:
            return CommandStatus.FAILED


def _fingerprint(command_id: str) -> int:
    # 64 bits: that any two of `LARGEST_MEMORY` ids are alike has a chance of 2e-9
    return int.from_bytes(hashlib.blake2b(command_id.encode(), digest_size=8).digest(), "big")


PROOFS = ("client", "lease", "sequence", "instance", "not_after", "after_stops")
"""Fields of a request that only authorise it."""


def _content(command: AxisCommand[CommandReply]) -> AxisCommand[CommandReply]:
    """Return the request without the fields that only authorise it."""
    return command.model_copy(update=dict.fromkeys(PROOFS))


def _changed_by(command: AxisCommand[CommandReply]) -> str | None:
    """Return in words what a command has set that moves nothing: its verb alone does not tell it."""
    if command.effect is not Effect.CHANGE or command.verb is Verb.POWER or command.capability is Capability.TRACES:
        return None
    values = command.model_dump(mode="json", exclude={"command_id", *PROOFS}, exclude_none=True)
    return ", ".join(f"{name} {value}" for name, value in values.items() if value is not False) or None


log = get_logger("events")

PUBLISHED_AFTER_S = 0.005
"""Longer than a command takes that is one exchange at 115200 baud and waits for another one."""
UNPUBLISHED_EVENTS = 64
"""With this many unpublished events, publish them at once."""
KEPT_EVENTS = 1000
PAGE_BYTES = 12_000
"""Events in one reply: with its other fields it stays below what a payload may have."""


@dataclass(frozen=True, slots=True)
class _News:
    """An event that is not yet published."""

    t: int
    seq: int
    number: int
    entry: LedgerEntry
    error: LdcndError | None


class EventLog:
    """Numbers, keeps and publishes what happens to commands.

    An event has its numbers and its instant at once. It is published a little later, because publishing takes as long
    as the rest of a command's way to the line, and a caller must not wait for it.
    """

    def __init__(self, publisher: Publisher, clock: Clock, run: str) -> None:
        self._run = run
        self._serial = count(1)
        self._end = 0
        self._publisher = publisher
        self._clock = clock
        self._loop = asyncio.get_running_loop()
        self._kept: deque[CommandEvent] = deque(maxlen=KEPT_EVENTS)
        self._sequence: dict[str, int] = {}
        self._news: deque[_News] = deque()
        self._refusals_logged = LogLimit(now_s=clock.now_s)

    def next_command_id(self) -> str:
        """Return an id for a command that came without one."""
        return f"{self._run}-{next(self._serial)}"

    def is_reserved(self, command_id: str) -> bool:
        """Tell whether an id is one that `next_command_id` has returned, or may return."""
        return command_id.startswith(f"{self._run}-")

    def changed(self, entry: LedgerEntry, error: LdcndError | None) -> None:
        """Take a change of the ledger; what is refused at once was never accepted."""
        if entry.status is CommandStatus.REFUSED and self._news and _is_acceptance(self._news[-1].entry, entry):
            self._news.pop()
            # nobody has seen its number: who asks for events has them published first
            self._end -= 1
            self._sequence[entry.axis] -= 1
        seq = self._sequence.get(entry.axis, 0)
        self._sequence[entry.axis] = seq + 1
        if not self._news:
            self._loop.call_later(PUBLISHED_AFTER_S, self.flush)
        self._news.append(_News(self._clock.now_ns(), seq, self._end, entry, error))
        self._end += 1
        if len(self._news) >= UNPUBLISHED_EVENTS:
            self.flush()

    def flush(self) -> None:
        """Publish and log all unpublished events."""
        while self._news:
            self._publish(self._news.popleft())

    def _publish(self, news: _News) -> None:
        entry, error, arrival = news.entry, news.error, news.entry.arrival
        event = CommandEvent(
            t=news.t,
            seq=news.seq,
            run=self._run,
            number=news.number,
            axis=entry.axis,
            command_id=entry.command_id,
            verb=entry.verb.value,
            on=entry.command.on if isinstance(entry.command, Power) else None,
            client=entry.client,
            login=entry.login,
            status=entry.status,
            reason=entry.reason,
            code=error.code.value if error else None,
            target=entry.target,
            position=arrival.position if arrival else None,
            last_position=arrival.last_position if arrival else None,
            following_error=arrival.following_error if arrival else None,
            settled=arrival.settled if arrival else None,
        )
        self._deliver(event)

    def note(
        self,
        axis: str,
        verb: str,
        status: CommandStatus,
        reason: str,
        *,
        client: str | None = None,
        login: str | None = None,
        code: str | None = None,
    ) -> None:
        """Enter what concerns an axis and is in no ledger: control that was lost or refused, a stop confirmed late."""
        # first, since what waits to be published has lower numbers
        self.flush()
        seq = self._sequence.get(axis, 0)
        self._sequence[axis] = seq + 1
        event = CommandEvent(
            t=self._clock.now_ns(),
            seq=seq,
            run=self._run,
            number=self._end,
            axis=axis,
            command_id=self.next_command_id(),
            verb=verb,
            client=client,
            login=login,
            status=status,
            reason=reason,
            code=code,
        )
        self._end += 1
        self._deliver(event)

    def noting(self, about: str) -> Note:
        """Return what enters events of one axis, module or line: it takes verb, status, reason and code."""
        return lambda verb, status, reason, code: self.note(about, verb, status, reason, code=code)

    def _deliver(self, event: CommandEvent) -> None:
        self._kept.append(event)
        try:
            self._publisher.publish_event(event)
        except SessionError as error:  # still served to `events` requests
            log.warning("event not published", axis=event.axis, command_id=event.command_id, reason=error.message)
        if event.status is CommandStatus.ACCEPTED:
            return  # what became of it follows
        passing = self._refusals_logged.admit() if event.status is CommandStatus.REFUSED else {}
        if passing is None:
            return
        log.info(
            "command",
            **passing,
            axis=event.axis,
            command_id=event.command_id,
            verb=event.verb,
            client=event.client,
            login=event.login,
            status=event.status.value,
            reason=event.reason,
        )

    def page(self, request: ReadEvents) -> EventList:
        """Return the requested events, as many as one reply takes."""
        self.flush()
        oldest = self._end - len(self._kept)
        if request.from_number is None:
            matching = [event for event in self._kept if request.axis in (None, event.axis)]
            events = _fitting(reversed(matching[-request.count :]))[::-1]
            return self._list(events, events[0].number if events else self._end, self._end)
        first = min(max(oldest, request.from_number), self._end)
        wanted = [event for event in list(self._kept)[first - oldest :] if request.axis in (None, event.axis)]
        events = _fitting(wanted[: request.count])
        return self._list(events, first, wanted[len(events)].number if len(events) < len(wanted) else self._end)

    def _list(self, events: list[CommandEvent], first: int, following: int) -> EventList:
        return EventList(
            run=self._run, first_number=first, next_number=following, end_number=self._end, events=tuple(events)
        )


def _is_acceptance(latest: LedgerEntry, refused: LedgerEntry) -> bool:
    return latest.command_id == refused.command_id and latest.status is CommandStatus.ACCEPTED


def _fitting(events: Iterable[CommandEvent]) -> list[CommandEvent]:
    """Return as many events as one reply takes, one at least."""
    fitting: list[CommandEvent] = []
    room = PAGE_BYTES
    for event in events:
        room -= len(to_json(event)) + 1
        if fitting and room < 0:
            break
        fitting.append(event)
    return fitting
