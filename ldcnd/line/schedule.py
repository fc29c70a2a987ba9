"""What goes on the wire next: jobs of three lanes, polls by their deadlines, and which nodes do not reply.

Pure: uses no clock and no wire. `Schedule` puts the lanes in order and bounds how long one waits for another;
`PollQueue` orders polls by deadline and priority; `PhaseOrder` chooses among polls of drives that reply at the end of
a servo cycle of their own (PIC-SERVO manual, 4.1). The drives on a line are not synchronised: a drive polled at the
right instant replies at once, a drive polled just too late makes the line wait for nearly a whole cycle. Phase and
length of each cycle are measured from the replies.
"""

import heapq
from collections import deque
from collections.abc import Callable, Sequence
from itertools import count
from typing import Any, Generic, Protocol, TypeVar

from ldcnd.contract.errors import BusBusy
from ldcnd.line.exchange import NO_DEADLINE_S, Exchange, Lane, Poller, Priority, Timing
from ldcnd.line.proof import MISSES_UNTIL_LOST, Proofs
from ldcnd.line.settings import ServoCycle

STOP, COMMAND, POLL, BACKGROUND = Lane  # Lane.STOP is looked up slowly, and turns are taken between two packets


class Queueable(Protocol):
    """The interface of a job that the schedule uses.

    Attributes:
        exchange: of which its node counts.
    """

    exchange: Exchange[Any]

    @property
    def abandoned(self) -> bool:
        """Whether no caller waits for this job any more."""

    @property
    def doubted(self) -> bool:
        """Whether it was sent and answered on a line that was not in step: it waits for a line that is."""


JobT = TypeVar("JobT", bound=Queueable)

COMMANDS_PER_POLL = 4
"""Most commands that may pass a due poll."""
POLLS_PER_BACKGROUND = 8
"""Most due polls that may pass a background job."""
LANE_LIMITS = {STOP: 256, COMMAND: 64, BACKGROUND: 64}


class Schedule(Generic[JobT]):
    """The jobs of a line, first in first out in each lane, and its pollers, see `PollQueue`.

    A stop goes before everything. Commands go before polls, but a due poll waits for at most `COMMANDS_PER_POLL`
    commands; background jobs wait for at most `POLLS_PER_BACKGROUND` polls.

    Attributes:
        polls: the pollers with their turns.
        mute: the nodes that do not reply.
    """

    def __init__(self, cycle: ServoCycle | None = None, proofs: Proofs | None = None) -> None:
        self._order = PhaseOrder(cycle) if cycle else None
        self._proofs = proofs or Proofs()
        self.polls = PollQueue(self._order.choose if self._order else None)
        self.mute = MuteNodes()
        self._pollers: set[Poller[Any]] = set()  # also those whose poll is on the wire
        self._probe: JobT | None = None
        self._jobs: dict[Lane, deque[JobT]] = {lane: deque() for lane in LANE_LIMITS}
        self._commands_in_a_row = 0
        self.polls_in_a_row = 0

    # -- jobs --------------------------------------------------------------------------------------------------------

    def push(self, job: JobT, lane: Lane) -> None:
        """Queue a job behind its lane's others, and before those that are doubted.

        Raises:
            BusBusy: the lane is full.
        """
        waiting = self._jobs[lane]
        if len(waiting) >= LANE_LIMITS[lane]:
            # those whose callers have gone are left in the queue until room is needed: none of them is sent
            waiting = self._jobs[lane] = deque(other for other in waiting if not other.abandoned)
        if len(waiting) >= LANE_LIMITS[lane]:
            raise BusBusy(
                f"{len(waiting)} exchanges wait in the {lane.name.lower()} lane already; nothing was sent",
                limit=LANE_LIMITS[lane],
                remedy="send commands more slowly",
            )
        waiting.insert(len(waiting) - sum(other.doubted for other in waiting), job)

    def requeue(self, job: JobT, lane: Lane) -> None:
        """Give a job that has to be sent again the next turn of its lane; one that is doubted, the last."""
        waiting = self._jobs[lane]
        if job.doubted:
            waiting.append(job)
        else:
            waiting.appendleft(job)

    def takes_probe(self) -> bool:
        """Tell whether a probe would be alone: no stop waits, and no other probe."""
        return self._probe is None and not self.stop_waits()

    def push_probe(self, job: JobT) -> None:
        """Let a job wait as the only stop would: behind every stop and in front of everything else."""
        self._probe = job

    def waiting(self, lane: Lane) -> list[JobT]:
        """Return the jobs of a lane, first to go first; polls are scheduled, not queued."""
        return list(self._jobs.get(lane, ()))

    def stop_waits(self) -> bool:
        """Tell whether a stop is queued whose caller still waits, and which does not wait for a line in step."""
        return any(not stop.abandoned and not stop.doubted for stop in self._jobs[STOP])

    def take_job(self, now_s: float) -> JobT | None:
        """Remove and return the job that goes on the wire now, or None when it is a poll's turn or nothing is due."""
        if self._probe is None and not any(self._jobs.values()):  # as nearly always, and this is between two packets
            self._commands_in_a_row = 0
            return None
        if stop := self._take_stop():
            return stop
        probe, self._probe = self._probe, None
        if probe and not probe.abandoned:
            return probe
        poll_due = self.polls.is_due(now_s)
        if not (poll_due and self._commands_in_a_row >= COMMANDS_PER_POLL) and (command := self._take(COMMAND)):
            self._commands_in_a_row += 1
            return command
        self._commands_in_a_row = 0
        if not poll_due or self.polls_in_a_row >= POLLS_PER_BACKGROUND:
            self.polls_in_a_row = 0
            return self._take(BACKGROUND)
        self.polls_in_a_row += 1
        return None

    def _take_stop(self) -> JobT | None:
        """Remove and return the next stop: one that a node awaits in vain lets those pass that will be answered."""
        stops = self._jobs[STOP]
        for stop in stops if self.mute.misses else ():
            if not (stop.abandoned or stop.doubted or stop.exchange.node in self.mute.misses):
                stops.remove(stop)
                return stop
        return self._take(STOP)

    def _take(self, lane: Lane) -> JobT | None:
        waiting = self._jobs[lane]
        while waiting:
            job = waiting.popleft()
            if not job.abandoned:
                return job
        return None

    def drain(self) -> list[JobT]:
        """Remove all pollers; remove and return all jobs, stops first."""
        self._pollers.clear()
        self.polls = PollQueue(self._order.choose if self._order else None)
        drained = [self._probe] if self._probe else []
        self._probe = None
        drained += [job for lane in sorted(self._jobs) for job in self._jobs[lane]]
        for waiting in self._jobs.values():
            waiting.clear()
        return drained

    # -- polls -------------------------------------------------------------------------------------------------------

    def add(self, poller: Poller[Any]) -> None:
        """Let a poller take part from its `due_at_s` on; adding it again only moves its turn."""
        self._pollers.add(poller)
        self.polls.schedule(poller, poller.due_at_s)

    def remove(self, poller: Poller[Any]) -> None:
        """Stop polling; a poll on the wire is still delivered."""
        self._pollers.discard(poller)
        self.polls.unschedule(poller)

    def reschedule(self, poller: Poller[Any], at_s: float) -> None:
        """Give a poller its next turn, unless it was removed while its poll was on the wire."""
        if poller in self._pollers:
            self.polls.schedule(poller, at_s)

    def prepare(self, node: int, asked_at_s: float, reply_s: float) -> None:
        """Choose the next poll and its items, while there is time: that takes longer than all else between two packets.

        Args:
            node: receiver of the request on the wire.
            asked_at_s: when the last bit of that request leaves, in loop time.
            reply_s: duration of the reply at the line's nominal rate.
        """
        at_s = self._order.free_at_s(node, asked_at_s, reply_s) if self._order else asked_at_s + reply_s
        if poller := self.polls.choose_ahead(at_s):
            poller.prepare(at_s)

    # -- outcomes ----------------------------------------------------------------------------------------------------

    def record_reply(self, exchange: Exchange[Any], timing: Timing | None = None) -> None:
        """Take note that a node replied.

        Args:
            exchange: to which it did.
            timing: of the reply to a poll, to learn the cycle of the drive.
        """
        if timing and self._order:
            self._order.observe(exchange.node, timing)
        # silence behind a packet that draws no reply says nothing of who is there
        if not exchange.reply_bytes or exchange.node not in self.mute.misses:
            return
        self._proofs.answered(exchange.node)
        if (also := self.mute.answered(exchange.node)) is not None:
            for poller in self._pollers:
                if poller.node == also:
                    self.polls.schedule(poller, poller.due_at_s)

    def record_loss(self, node: int) -> None:
        """Take note that a node did not reply."""
        self.mute.missed(node)
        self._proofs.missed(node, self.mute.misses[node])

    def put_off(self, poller: Poller[Any], now_s: float, lost_s: float) -> None:
        """Let a poller pause whose poll was lost, the longer the more often.

        Args:
            poller: of a node whose loss was recorded.
            now_s: the present, in loop time.
            lost_s: time that a poll without a reply takes on the line, resynchronisation included.
        """
        self.reschedule(poller, max(poller.due_at_s, now_s + self.mute.pause_s(poller.node, lost_s)))


MUTE_SHARE = 0.005
"""Fraction of the line's time that polls without a reply may take, so that mute nodes cost the others little."""
FIRST_BACKOFF_S = 0.05
LONGEST_BACKOFF_S = 5.0
"""Longest pause between two polls of a mute node, seconds, whatever fraction of the line they take."""


class MuteNodes:
    """The nodes that do not reply.

    Attributes:
        misses: consecutive exchanges without a reply, by node; nodes that reply are absent.
    """

    def __init__(self) -> None:
        self.misses: dict[int, int] = {}
        self._lost_polls: dict[int, int] = {}
        self._backed_off: set[int] = set()

    def failing(self) -> set[int]:
        """Return the nodes that did not reply to their last exchange."""
        return set(self.misses)

    def missed(self, node: int) -> None:
        """Count an exchange without a reply."""
        self.misses[node] = self.misses.get(node, 0) + 1

    def pause_s(self, node: int, lost_s: float) -> float:
        """Return how long to pause polling a node whose poll has just been lost, in seconds.

        Only its polls count: the first node of a line without any reply is also asked after each loss of the others,
        and its axis would never learn that it is lost.

        Args:
            node: its miss was counted.
            lost_s: time that a poll without a reply takes on the line.
        """
        self._lost_polls[node] = lost = self._lost_polls.get(node, 0) + 1
        beyond = lost - MISSES_UNTIL_LOST
        if beyond < 0:
            return 0.0
        self._backed_off.add(node)
        # together they take the fraction that one may take, so each pauses the longer the more they are
        many = len(self._backed_off)
        doubled_s = many * FIRST_BACKOFF_S * 2.0 ** min(10, beyond)
        return min(doubled_s, many * lost_s / MUTE_SHARE, LONGEST_BACKOFF_S)

    def answered(self, node: int) -> int | None:
        """Note a reply; return another node to poll at once, if this one was backed off.

        A common cause, such as a connector or the supply of one node, often ends for all mute nodes together.
        """
        self._lost_polls.pop(node, None)
        if self.misses.pop(node, None) is None or node not in self._backed_off:
            return None
        self._backed_off.discard(node)
        return min(self._backed_off, key=lambda other: (other < node, other), default=None)  # the chain, once round

    def forget(self) -> None:
        """Clear all misses: the line was opened."""
        self.misses.clear()
        self._lost_polls.clear()
        self._backed_off.clear()


CHOICE = 16
"""Most polls with equal deadlines to choose among, because comparing each takes time."""
SHORTEST_ROUND, LONGEST_ROUND = 0.5, 1.5
"""Turns for which a late poll waits, as fractions of the number of late polls. The upper one keeps the longest gap
below two mean ones, also when several are passed over.
"""
FEW = 4
"""The longest wait is shorter by `FEW` / number of late polls, in turns: with few of them chance weighs more."""

Choose = Callable[[Sequence[Poller[Any]], float], Poller[Any]]
"""Which of several polls to run now, at an instant in loop time; there is always one."""


class PollRank:
    """Polls of one priority that are due; false while there is none. The earliest deadline goes first.

    Where deadlines leave a choice, `choose` decides: among polls with the same deadline, and among late ones. Late
    polls have no deadline to lose, so they take turns: half of them go before one goes again, and one passed over for
    `LONGEST_ROUND` rounds goes now.
    """

    def __init__(self, choose: Choose | None) -> None:
        self._choose = choose
        self._turn = 0
        self._late: list[tuple[int, float, Poller[Any]]] = []  # since which turn, and since when it is due
        # those that were not late yet: deadline, since when due, serial number: equal ones go in the order of these
        self.due: list[tuple[float, float, int, Poller[Any]]] = []

    def __bool__(self) -> bool:
        return bool(self.due or self._late)

    @property
    def since_s(self) -> float:
        """Since when the first one is due."""
        return self._late[0][1] if self._late else self.due[0][1]

    @property
    def deadline_s(self) -> float:
        """The earliest deadline of those that were not late yet when one was last taken."""
        return self.due[0][0] if self.due else NO_DEADLINE_S

    def is_late(self, now_s: float) -> bool:
        """Tell whether the deadline of one has passed."""
        return bool(self._late) or self.deadline_s <= now_s

    def remove(self, poller: Poller[Any]) -> None:
        """Remove a poll; unknown ones are ignored."""
        self._late = [late for late in self._late if late[2] is not poller]
        self.due = [due for due in self.due if due[3] is not poller]
        heapq.heapify(self.due)

    def take(self, now_s: float) -> Poller[Any]:
        """Remove and return the one that goes now."""
        if self._choose is None:
            return heapq.heappop(self.due)[3]
        self._turn += 1
        while self.due and self.due[0][0] <= now_s:
            _, at_s, _, poller = heapq.heappop(self.due)
            self._late.append((self._turn, at_s, poller))
        return self._take_late(self._choose, now_s) if self._late else self._take_equal(self._choose, now_s)

    def _take_late(self, choose: Choose, now_s: float) -> Poller[Any]:
        since, _, first = self._late[0]
        late = len(self._late)
        if self._turn - since >= LONGEST_ROUND * late - FEW / late:
            del self._late[0]
            return first
        before = self._turn - SHORTEST_ROUND * late
        among = [poller for turn, _, poller in self._late if turn <= before] or [first]
        chosen = choose(among, now_s)
        del self._late[among.index(chosen)]  # both begin with the one that is late longest
        return chosen

    def _take_equal(self, choose: Choose, now_s: float) -> Poller[Any]:
        equal = [heapq.heappop(self.due)]
        while len(equal) < CHOICE and self.due and self.due[0][0] == equal[0][0]:
            equal.append(heapq.heappop(self.due))
        chosen = choose([poller for *_, poller in equal], now_s)
        for entry in equal:
            if entry[3] is not chosen:
                heapq.heappush(self.due, entry)
        return chosen


NORMAL = Priority.NORMAL
POLLS_PER_LOWER = 16
"""Most polls that may pass a late one of a lower priority. On a line of 31 axes at 19200 baud that one priority could
fill alone, each of the others is then polled every five seconds, as seldom as a mute drive.
"""


class PollQueue:
    """Pollers, each with its next turn.

    As long as no poll that is due is late, the earliest deadline goes first, whatever the priority. Once one is, the
    line has fallen behind; until it has caught up, which is when nothing with a deadline is due, the highest priority
    goes first, and deadlines count within one priority only. That concerns all due polls and not
    just the late ones: a poll that only counts once it is late has lost a turn by then.

    A late poll of a lower priority waits for at most `POLLS_PER_LOWER` others for each late one before it.

    The next poll can be chosen ahead, while the line is busy. As long as the line keeps up, a poll that becomes due
    meanwhile goes first if its deadline is earlier, so the earliest deadline never waits for a choice made too soon.

    Args:
        choose: chooses where deadlines leave a choice, see `PollRank`; None for the one that is due longest.
    """

    def __init__(self, choose: Choose | None) -> None:
        self._ranks = tuple(PollRank(choose) for _ in Priority)  # highest first
        self._only: PollRank | None = self._ranks[NORMAL]  # None once other priorities take part
        self._later: list[tuple[float, int, Poller[Any]]] = []
        self._turns: dict[Poller[Any], int] = {}  # those that are valid of `_later`
        self._due: set[Poller[Any]] = set()
        self._serial = count()
        self._behind = False
        self._passed = 0
        self._ahead: Poller[Any] | None = None  # the one chosen ahead

    def schedule(self, poller: Poller[Any], at_s: float) -> None:
        """Let a poller have its next turn at `at_s`; replaces any turn it had."""
        if poller in self._due or poller is self._ahead:
            self.unschedule(poller)
        if poller.priority is not NORMAL:
            self._only = None
        self._turns[poller] = serial = next(self._serial)
        heapq.heappush(self._later, (at_s, serial, poller))

    def unschedule(self, poller: Poller[Any]) -> None:
        """Remove a poller; unknown ones are ignored."""
        self._turns.pop(poller, None)
        if poller is self._ahead:
            self._ahead = None
        if poller in self._due:
            self._due.discard(poller)
            self._ranks[poller.priority].remove(poller)

    def next_due_s(self) -> float:
        """Return when the next poller is due; infinity when there is none."""
        if self._ahead:
            return self._ahead.due_at_s
        if self._due:
            return next(rank.since_s for rank in self._ranks if rank)
        while self._later and self._turns.get(self._later[0][2]) != self._later[0][1]:
            heapq.heappop(self._later)
        return self._later[0][0] if self._later else float("inf")

    def is_due(self, now_s: float) -> bool:
        """Tell whether there is a poll to run."""
        if self._ahead:
            return True
        if self._later and self._later[0][0] <= now_s:
            self._rank_due(now_s)
        if self._due:
            return True
        self._behind = False
        return False

    def choose_ahead(self, at_s: float) -> Poller[Any] | None:
        """Choose among the polls due at about `at_s`; None when none is due, or one is chosen already."""
        if self._ahead or not self.is_due(at_s):
            return None
        self._ahead = ahead = self._take(at_s)
        return ahead

    def take(self, now_s: float) -> Poller[Any] | None:
        """Remove and return the poller whose turn it is, or None when none is due."""
        ahead = self._ahead
        if ahead is None:
            return self._take(now_s) if self.is_due(now_s) else None
        # the one chosen ahead keeps its place: it goes next
        if self._is_overtaken(ahead, now_s):
            return self._take(now_s)
        self._ahead = None
        return ahead

    def _is_overtaken(self, ahead: Poller[Any], now_s: float) -> bool:
        if self._later and self._later[0][0] <= now_s:
            self._rank_due(now_s)
        if (only := self._only) is not None:
            return bool(only.due) and only.due[0][0] < ahead.deadline_at_s
        if self._behind:
            return False
        return any(rank.deadline_s < ahead.deadline_at_s for rank in self._ranks)

    def _rank_due(self, now_s: float) -> None:
        later, turns = self._later, self._turns
        while later and later[0][0] <= now_s:
            at_s, serial, poller = heapq.heappop(later)
            if turns.get(poller) == serial:
                del turns[poller]
                self._due.add(poller)
                rank = self._ranks[poller.priority]
                heapq.heappush(rank.due, (poller.deadline_at_s, at_s, serial, poller))

    def _take(self, now_s: float) -> Poller[Any]:
        rank = self._next_rank(now_s) if self._only is None else self._only
        poller = rank.take(now_s)
        self._due.discard(poller)
        return poller

    def _next_rank(self, now_s: float) -> PollRank:
        """Return the priority whose turn it is."""
        ranks = [rank for rank in self._ranks if rank]
        late = [rank for rank in ranks if rank.is_late(now_s)]
        earliest = min(ranks, key=lambda rank: rank.deadline_s)
        if late:
            self._behind = True
        elif earliest.deadline_s == NO_DEADLINE_S:
            self._behind = False
        if not self._behind:
            return earliest
        lower = [rank for rank in late if rank is not ranks[0]]
        self._passed = self._passed + 1 if lower else 0
        if self._passed <= POLLS_PER_LOWER:
            return ranks[0]
        self._passed = 0
        return min(lower, key=lambda rank: rank.since_s)


MOST_DRIFT = 0.001
"""Largest deviation of a cycle, as a fraction of its nominal length: far more than crystals differ."""
LONGEST_GAP_S = 1.0
"""Longest pause, seconds, over which cycles are counted; after a longer one the phase is measured again."""
ENOUGH = 4
"""Replies observed before a prediction is used."""
FORGETTING = 0.1
"""Least weight of a new reply in the phase."""
FORGETTING_DRIFT = 0.005
"""Least weight of a new reply in the length of the cycle."""
MOST_SCATTER = 0.15
"""Largest scatter of replies for predictions, as a fraction of a cycle; some USB adapters scatter more."""
GUARD_UP, GUARD_DOWN = 0.06, 0.002
"""Steps of the guard time, as fractions of a cycle: up after a missed cycle, down after each other one, so that about
one in thirty is missed."""
MOST_GUARD = 0.5


class PhaseTracker:
    """The cycle of one node: a straight line through the instants at which its replies began.

    Weights are those of a least-squares fit through all replies so far, until forgetting sets in.

    Attributes:
        locked: enough replies with little scatter, so predictions are used.
    """

    __slots__ = ("_count", "_cycle_s", "_period_s", "_scatter_s", "_tick_s", "locked")

    def __init__(self, cycle_s: float) -> None:
        self.locked = False
        self._cycle_s = cycle_s
        self._period_s = cycle_s
        self._tick_s = 0.0
        self._scatter_s = 0.0
        self._count = 0

    @property
    def period_s(self) -> float:
        """The length of the cycle on the host's clock."""
        return self._period_s

    def observe(self, tick_s: float) -> None:
        """Take the instant at which a reply began."""
        cycles = round((tick_s - self._tick_s) / self._period_s)
        if not self._count or tick_s - self._tick_s > LONGEST_GAP_S:
            self._tick_s, self._count, self.locked = tick_s, 1, False
            return
        # sooner than half a cycle after the one before, it tells nothing of the length
        if cycles < 1:
            return
        self._count = count = self._count + 1
        expected_s = self._tick_s + cycles * self._period_s
        error_s = tick_s - expected_s
        # of a line through n equidistant points its end is corrected by 2(2n - 1) / n(n + 1), its slope by 6 / n(n + 1)
        weight = max(FORGETTING, 2.0 * (2 * count - 1) / (count * (count + 1)))
        drift_weight = max(FORGETTING_DRIFT, 6.0 / (count * (count + 1)))
        self._tick_s = expected_s + min(1.0, weight) * error_s
        period_s = self._period_s + drift_weight * error_s / cycles
        slack_s = MOST_DRIFT * self._cycle_s
        self._period_s = min(max(period_s, self._cycle_s - slack_s), self._cycle_s + slack_s)
        self._scatter_s += FORGETTING * (abs(error_s) - self._scatter_s)
        self.locked = count >= ENOUGH and self._scatter_s < MOST_SCATTER * self._cycle_s

    def wait_s(self, from_s: float) -> float:
        """Return how long after an instant the next cycle ends."""
        return (self._tick_s - from_s) % self._period_s


class PhaseOrder:
    """Choice of the node for which the line would wait least.

    A guard time covers a host that sends and reads late; its length follows from the cycles that were missed.
    """

    def __init__(self, cycle: ServoCycle) -> None:
        self.guard_s = 0.0
        self._cycle_s = cycle.length_s
        self._stretch = cycle.stretch
        self._trackers: dict[int, PhaseTracker] = {}
        self._request_s: dict[int, float] = {}
        self._expected_s: dict[int, float] = {}

    def choose(self, pollers: Sequence[Poller[Any]], now_s: float) -> Poller[Any]:
        """Return the one whose reply would begin first after its request; the first one if none can be predicted."""
        best, shortest_s = pollers[0], float("inf")
        guard_s = self.guard_s
        for poller in pollers:
            tracker = self._trackers.get(poller.node)
            # what a drive takes on average whose cycle is not known
            wait_s = self._cycle_s / 2
            if tracker and tracker.locked:
                wait_s = tracker.wait_s(now_s + self._request_s[poller.node] + guard_s)
            if wait_s < shortest_s:
                best, shortest_s = poller, wait_s
        self._expected_s[best.node] = shortest_s + guard_s
        return best

    def free_at_s(self, node: int, asked_at_s: float, reply_s: float) -> float:
        """Return when the line is likely to be free again behind a request that is over at an instant.

        Args:
            node: receiver of the request.
            asked_at_s: end of the request, in loop time.
            reply_s: duration of the reply at the line's nominal rate.
        """
        tracker = self._trackers.get(node)
        wait_s = tracker.wait_s(asked_at_s) if tracker and tracker.locked else self._cycle_s / 2
        return asked_at_s + wait_s + self._stretch * reply_s

    def observe(self, node: int, timing: Timing) -> None:
        """Learn from a reply to a poll."""
        tracker = self._trackers.get(node)
        if tracker is None:
            tracker = self._trackers[node] = PhaseTracker(self._cycle_s)
        # `true_until_s` is reckoned at the line's rate, and the drive sends at what its divisor makes of it
        began_s = timing.received_at_s - self._stretch * (timing.received_at_s - timing.true_until_s)
        expected_s = self._expected_s.pop(node, None)
        if expected_s is not None and tracker.locked:
            # a whole cycle later than expected: the request came too late for the one that was meant
            missed = began_s - timing.true_from_s > expected_s + self._cycle_s / 2
            step = GUARD_UP if missed else -GUARD_DOWN
            self.guard_s = min(max(0.0, self.guard_s + step * self._cycle_s), MOST_GUARD * self._cycle_s)
        self._request_s[node] = timing.true_from_s - timing.sent_at_s
        tracker.observe(began_s)
