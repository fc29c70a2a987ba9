"""One rig as a program sees it: what it is, what it says, what it does."""

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Mapping, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from difflib import get_close_matches
from functools import partial
from typing import TYPE_CHECKING, TypeVar

from ldcnd.client.own_samples import Origin
from ldcnd.client.rest import REST_S, until_at_rest
from ldcnd.contract.codec import Encoding, decode_error, decode_received, encode, valid
from ldcnd.contract.commands import LONGEST_NAME, AxisCommand, Command, CommandReply, Effect, Halt, Stop, StopReply
from ldcnd.contract.errors import CommandExpired, LdcndError, OutcomeUnknown, SessionError, UnknownAxis
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.history import AxisInstant
from ldcnd.contract.keys import ALL_DAEMONS, ALL_RUNS, RIG_ITSELF, Keys
from ldcnd.contract.meta import AxisInfo, BusInfo, DaemonInfo
from ldcnd.contract.samples import (
    FaultSample,
    MonitorName,
    MonitorSample,
    PositionSample,
    StateSample,
    TelemetryItem,
    VelocitySample,
    sample_model,
)
from ldcnd.contract.samples import Sample as Measurement
from ldcnd.net.hand_over import Answer
from ldcnd.net.session import (
    NO_PARAMETERS,
    UNDELIVERED_SAMPLES,
    Declaration,
    OnSample,
    Publication,
    SampleKind,
    Session,
)

if TYPE_CHECKING:  # clients that only read need no model of leases and outcomes
    from ldcnd.contract.events import CommandOutcome
    from ldcnd.contract.leases import LeaseReply

ModelT = TypeVar("ModelT", bound=Frozen)
ReplyT = TypeVar("ReplyT", bound=Frozen)
ResultT = TypeVar("ResultT")
OnDaemon = Callable[[str, str, bool], None]
"""Learns that of a rig a run of the daemon has appeared (True) or vanished (False)."""

TAKING_CONTROL = "acquire"
"""The verb after which commands are meant for the daemon that runs then."""
UNHEARD_S = 3.0
"""How long what takes energy out is sent again while no daemon hears it, seconds: a link is made again within two."""
ASK_AGAIN_S = 0.1
"""Pause between two such queries, seconds."""
KEPT_SAMPLES = 256
"""Maximum number of samples kept for a slow watcher; the oldest are dropped."""

KEPT_PUBLISHED = 4096
"""Maximum number of samples kept for a reader of everything on a rig: enough for one second of a large one."""


class Samples:
    """Telemetry of one rig as an endless iterator; drops the oldest when its reader is too slow.

    Attributes:
        dropped: how many samples the reader was too slow for.
        missed: how many the network dropped, by the numbers of those that came. A daemon that is restarted
            begins with number 0; the last samples of its former run are not counted.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self.missed = 0
        self._next: dict[str, int] = {}
        self._kept: deque[tuple[str, Measurement]] = deque(maxlen=KEPT_SAMPLES)
        self._ready = asyncio.Event()

    def take(self, sample: Publication) -> None:
        """Take a sample from the session."""
        if sample.kind is SampleKind.DELETE:
            return
        axis, _, item = sample.key.rpartition("/tele/")[2].partition("/")
        model = sample_model(item)
        if model is None:
            return  # events, and what newer daemons publish
        measurement = decode_received(model, sample.payload, sample.encoding)
        self.missed += max(0, measurement.seq - self._next.get(sample.key, measurement.seq))
        self._next[sample.key] = measurement.seq + 1
        self.dropped += len(self._kept) == KEPT_SAMPLES
        self._kept.append((axis, measurement))
        self._ready.set()

    def __aiter__(self) -> "Samples":
        return self

    async def __anext__(self) -> tuple[str, Measurement]:
        """Return the axis and its next sample."""
        while not self._kept:
            self._ready.clear()
            await self._ready.wait()
        return self._kept.popleft()


class RigClient:
    """Queries and commands one rig over an open session.

    Attributes:
        rig: its name.
        session: the session.
        keys: the keys of the rig.
        lease: under this one is sent what can be sent under a lease and names none; None without one.
        held: leases that this program has acquired here and not given back, by token: who acquires again names them.
        run: names the run of the daemon that was found last, whose samples are taken; None before it was found.
    """

    def __init__(self, session: Session, rig: str, lease: str | None = None) -> None:
        self.rig = rig
        self.lease = lease
        self.held: dict[str, LeaseReply] = {}
        self.run: str | None = None
        self.session = session
        self.keys = Keys(rig)
        self._instance: str | None = None
        self._meeting = asyncio.Lock()
        self._origin = Origin(self.daemon)

    async def read(self, key: str, model: type[ModelT]) -> list[ModelT]:
        """Return the values of the keys of the rig that match `key`."""
        return [self._decoded(answer, model) for answer in await self._values(key)]

    async def _values(self, key: str, parameters: Mapping[str, str] = NO_PARAMETERS) -> list[Answer]:
        """Return what the daemon of the rig answers: others, such as a storage with old values, may answer as well."""
        answers = await self.session.query(key, parameters=parameters, everyone=True)
        if any(answer.source == self._origin.source for answer in answers):
            return [answer for answer in answers if answer.source == self._origin.source]
        if answers:
            try:
                await self.daemon()
            except SessionError:
                return []
        return [answer for answer in answers if answer.source == self._origin.source]

    @property
    def rivals(self) -> str | None:
        """What was dropped because other programs than the daemon have published it, in words; None if nothing was."""
        count = self._origin.dropped
        who = "another program publishes" if len(self._origin.rivals) == 1 else "other programs publish"
        return f"{who} on the keys of rig {self.rig}; such values are left out, {count} so far" if count else None

    def watch_rivals(self, on_rival: Callable[[], None]) -> None:
        """Call back whenever another program begins to publish on the keys of the rig."""
        self._origin.on_rival = on_rival

    async def subscribe(
        self, key: str, take: OnSample, kept: int = UNDELIVERED_SAMPLES, *, linger_s: float = 0.0
    ) -> Declaration:
        """Hand what the daemon publishes on the keys that match to `take`; as `Session.subscribe`."""
        gate = self._origin.gate(take)
        try:
            declaration = await self.session.subscribe(key, gate.admit, kept, linger_s=linger_s)
        except BaseException:
            await gate.close()
            raise

        async def close() -> None:
            await declaration.close()
            await gate.close()

        return Declaration(close, lambda: declaration.load)

    async def daemon(self) -> DaemonInfo:
        """Return what the daemon says about itself.

        Raises:
            SessionError: no daemon serves this rig.
        """
        answers = await self.session.query(self.keys.daemon, everyone=True)
        found = [(self._decoded(answer, DaemonInfo), answer.source) for answer in answers if not answer.is_error]
        if not found:
            return self._one(answers, DaemonInfo)
        daemon, source = max(found, key=lambda each: each[0].started)
        self.run = daemon.instance  # before its samples are let through
        self._origin.found(source)
        return daemon

    async def at(self, t: int, axis: str = "*") -> dict[str, AxisInstant]:
        """Return where an axis, or each of them, was at an instant; see `Rig.at`."""
        return {name: instants[0] for name, instants in (await self.past(str(t), axis)).items()}

    async def past(self, time: str, axis: str = "*") -> dict[str, list[AxisInstant]]:
        """Return where an axis, or each of them, was at an instant or in a range, as `_time` of a selector says it."""
        found: dict[str, list[AxisInstant]] = {}
        for answer in await self._values(self.keys.at(axis), {"_time": time}):
            found.setdefault(answer.key.split("/")[-2], []).append(self._decoded(answer, AxisInstant))
        return found

    async def axes(self) -> list[AxisInfo]:
        """Return all axes, in the order of their addresses."""
        return sorted(await self.read(self.keys.axis_pattern, AxisInfo), key=lambda axis: (axis.bus, axis.address))

    async def buses(self) -> list[BusInfo]:
        """Return all lines."""
        return await self.read(self.keys.bus_pattern, BusInfo)

    async def descriptions(self) -> dict[str, bytes]:
        """Return all that describes the rig, as JSON, by what follows `meta/` in its key; schemas are left out."""
        found: dict[str, bytes] = {}
        for pattern in self.keys.description_patterns:
            for answer in await self._values(pattern):
                if answer.is_error:
                    raise decode_error(answer.payload, answer.encoding)
                if answer.key != self.keys.health:
                    found[answer.key.partition("/meta/")[2]] = answer.payload
        return found

    async def last(self, axis: str, item: str) -> Measurement | None:
        """Return the last value of an item, or None when there is none (yet)."""
        model = sample_model(item)
        answers = await self._values(self.keys.telemetry_pattern(axis, item)) if model else []
        return self._decoded(answers[0], model) if model and answers else None

    async def monitors(self, axis: str) -> dict[MonitorName, MonitorSample]:
        """Return the last value of every monitor that an axis publishes."""
        answers = await self._values(self.keys.monitor(axis, "*"))
        return {MonitorName(answer.key.rpartition("/")[2]): self._decoded(answer, MonitorSample) for answer in answers}

    async def states(self) -> dict[str, StateSample]:
        """Return the last state of every axis that has one."""
        return await self._of_all_axes(TelemetryItem.STATE, StateSample)

    async def positions(self) -> dict[str, PositionSample]:
        """Return the last position of every axis that has one."""
        return await self._of_all_axes(TelemetryItem.POSITION, PositionSample)

    async def velocities(self) -> dict[str, VelocitySample]:
        """Return the last velocity of every axis that has one."""
        return await self._of_all_axes(TelemetryItem.VELOCITY, VelocitySample)

    async def faults(self) -> dict[str, FaultSample]:
        """Return what is wrong with every axis that has published enough to tell."""
        return await self._of_all_axes(TelemetryItem.FAULT, FaultSample)

    async def state(self, axis: str) -> StateSample | None:
        """Return the axis's last state, or None when there is none yet."""
        sample = await self.last(axis, TelemetryItem.STATE)
        return sample if isinstance(sample, StateSample) else None

    async def command(self, axis: str, command: AxisCommand[ReplyT], timeout_s: float | None = None) -> ReplyT:
        """Send one command; returns once the drive has acknowledged it.

        Args:
            axis: which axis.
            command: what to do.
            timeout_s: longest wait for the reply; what such a command may take, when missing.

        Raises:
            LdcndError: as the daemon refused it, of the same class.
            OutcomeUnknown: no answer came in time, or the daemon has disappeared; the command may be carried out all
                the same.
            SessionError: no daemon serves this rig, or access control does not let this login command it.
        """
        if self._instance is None and not command.takes_energy_out:
            await self.meet(f"axis {axis}: {command.verb}")
        meant = command if command.instance else command.model_copy(update={"instance": self._instance})
        try:
            return await self._answer(axis, meant, timeout_s)
        except CommandExpired as error:
            if error.value == meant.instance:
                self._instance = None  # the daemon was restarted: this command is lost, the next one may be new
            raise

    async def meet(self, what: str) -> None:
        """Learn which daemon commands are meant for, unless that is known.

        Args:
            what: the command that waits for it, for the error.

        Raises:
            SessionError: none answers.
        """
        async with self._meeting:  # commands that wait for it go on in their order
            if self._instance is None:
                try:
                    self._instance = (await self.daemon()).instance
                except OutcomeUnknown as error:  # of a question: the command itself is not on its way
                    raise SessionError(
                        f"{what}: the daemon of rig {self.rig} does not answer; nothing was sent"
                    ) from error

    async def ask(self, command: Command[ReplyT], axis: str = RIG_ITSELF, timeout_s: float | None = None) -> ReplyT:
        """Send what is no command of an axis: to the rig as a whole, or a question about an axis.

        Raises:
            LdcndError: as the daemon refused it, of the same class.
        """
        reply = await self._answer(axis, command, timeout_s)
        if command.verb == TAKING_CONTROL:
            self._instance = None  # control is of the daemon that runs now, restarted or not
        return reply

    async def _of_all_axes(self, item: TelemetryItem, model: type[ModelT]) -> dict[str, ModelT]:
        answers = await self._values(self.keys.telemetry_pattern("*", item))
        return {self.keys.parse_telemetry(answer.key).axis: self._decoded(answer, model) for answer in answers}

    async def _answer(self, axis: str, command: Command[ReplyT], timeout_s: float | None) -> ReplyT:
        if self.lease and getattr(command, "lease", self.lease) is None:
            under = {"lease": self.lease, "client": None}  # a lease names its client; not every command has the field
            known = type(command).model_fields
            command = command.model_copy(update={name: value for name, value in under.items() if name in known})
        payload, encoding = encode(command, Encoding.MSGPACK)
        key = self.keys.command(axis, command.verb)
        longest_s = command.answer_s if timeout_s is None else timeout_s
        ask = partial(
            self.session.query,
            key,
            payload,
            encoding=encoding,
            timeout_s=longest_s,
            everyone=command.takes_energy_out,  # is for every daemon of the rig: only one has the line
            # a halt that overtakes the motion which it is to end has no effect
            in_order=command.effect is Effect.MOTION
            or isinstance(command, Halt)
            or bool(getattr(command, "sequence", None)),
        )
        answers = await (_until_heard(ask, longest_s) if command.takes_energy_out else ask())
        if not answers:
            whose = "" if axis == RIG_ITSELF else f"axis {axis}: "
            raise await self._unanswered(f"{whose}{command.verb}")
        if command.takes_energy_out:
            answers = [_of_everyone(answers)]
        return self._one(answers, command.reply_model())

    async def stop(self, axis: str | None = None, timeout_s: float = 5.0, client: str | None = None) -> StopReply:
        """Stop one axis, or the whole rig; the events tell the first 64 characters of `client` as who it was."""
        request = Stop(client=client[:LONGEST_NAME] if client else None)
        payload, encoding = encode(request, Encoding.MSGPACK)
        key, query = self.keys.stop(axis), self.session.query
        ask = partial(query, key, payload, encoding=encoding, timeout_s=timeout_s, urgent=True, everyone=True)
        answers = await _until_heard(ask, timeout_s)
        replies = [self._decoded(answer, StopReply) for answer in answers if not answer.is_error]
        if not answers:
            raise SessionError(
                f"the stop is not confirmed: no daemon of rig {self.rig} answers, or this login may not query it",
                remedy="send it again; check that the daemon runs and that you connect to it",
            )
        if not replies:
            return self._one(answers, StopReply)
        # the drives confirm it to the daemon that has the line: whichever of them says so, it is so
        axes = tuple(dict.fromkeys(name for reply in replies for name in reply.axes))
        confirmed, unstoppable, standing, kept = (
            {name for reply in replies for name in getattr(reply, what)}
            for what in ("confirmed", "unstoppable", "standing", "kept")
        )
        warning = next((reply.warning for reply in replies if reply.warning), "")
        return StopReply.of(
            axes,
            confirmed=confirmed,
            unstoppable=unstoppable,
            standing=standing,
            kept=kept,
            stops={name: count for reply in replies for name, count in reply.stops.items()},
            warning=warning,
        )

    async def position(self, axis: str) -> PositionSample | None:
        """Return the axis's last position, or None when there is none yet."""
        sample = await self.last(axis, TelemetryItem.POSITION)
        return sample if isinstance(sample, PositionSample) else None

    @asynccontextmanager
    async def values(
        self, axis: str, item: str, take: Callable[[Publication], None], linger_s: float = 0.0
    ) -> AsyncIterator[None]:
        """Hand one item of an axis to `take`, encoded as it came, for the time of the context."""
        key = self.keys.telemetry_pattern(axis, item)
        declaration = await self.subscribe(key, take, KEPT_SAMPLES, linger_s=linger_s)
        try:
            yield
        finally:
            await declaration.close()

    @asynccontextmanager
    async def samples(self, axis: str = "*", item: str = "*") -> AsyncIterator[Samples]:
        """Subscribe to telemetry for the time of the context."""
        samples = Samples()
        declaration = await self.subscribe(self.keys.telemetry_pattern(axis, item), samples.take)
        try:
            yield samples
        finally:
            await declaration.close()

    @asynccontextmanager
    async def published(
        self, take: Callable[[Publication], None], kept: int = KEPT_PUBLISHED, linger_s: float = 0.0
    ) -> AsyncIterator[Callable[[], int]]:
        """Hand all telemetry, events and health reports to `take`, as they come, for the time of the context.

        Args:
            take: takes what was published.
            kept: maximum number of waiting samples of a kind; yields a function that returns how many were dropped.
            linger_s: how long a sample may wait for others, which costs less than taking each by itself.
        """
        async with AsyncExitStack() as declared:
            declarations: list[Declaration] = []
            for key in (self.keys.all_telemetry, f"{self.keys.health}/**"):
                declaration = await self.subscribe(key, take, kept, linger_s=linger_s)
                declared.push_async_callback(declaration.close)
                declarations.append(declaration)
            yield lambda: sum(declaration.load.lost for declaration in declarations)

    async def last_published(self) -> list[Publication]:
        """Return the last value of every telemetry and health key, in msgpack; no samples of traces."""
        keys = (
            self.keys.telemetry_pattern("*", "*"),
            self.keys.telemetry_pattern("*", "monitor") + "/*",
            f"{self.keys.health}/**",
        )
        answers = [a for key in keys for a in await self._values(key, {"enc": "msgpack"})]
        return [
            Publication(
                answer.key, answer.payload, answer.encoding, SampleKind.PUT, answer.measured_at_ns, answer.source
            )
            for answer in answers
            if not answer.is_error
        ]

    async def outcome(self, command_id: str) -> "CommandOutcome":
        """Query the daemon for the outcome of a command.

        Raises:
            UnknownCommand: it does not know it, or not any more.
        """
        from ldcnd.contract.events import ReadOutcome  # noqa: PLC0415 - clients that only read need none

        return await self.ask(valid(ReadOutcome, command_id=command_id))

    async def end_of(self, reply: CommandReply) -> tuple[StateSample, "CommandOutcome"]:
        """Wait until a command has ended; return the state after it, and how: another one may have taken over.

        Raises:
            OutcomeUnknown: the drive stopped answering, nothing comes from the axis any more, or the daemon was
                restarted.
        """
        from ldcnd.client.ends import forgotten  # noqa: PLC0415 - clients that only read need none

        state, outcome = await self._end(reply.axis, reply.command_id)
        if outcome is None:
            raise forgotten(reply)
        return state, outcome

    async def wait_for_end(self, axis: str, command_id: str) -> StateSample:
        """Wait until a command has ended, or its daemon does not know it any more, and return the state after it.

        Raises:
            OutcomeUnknown: the drive stopped answering, or nothing comes from the axis any more.
        """
        return (await self._end(axis, command_id))[0]

    async def _end(self, axis: str, command_id: str) -> "tuple[StateSample, CommandOutcome | None]":
        from ldcnd.client.ends import until_ended  # noqa: PLC0415 - clients that only read need none

        async with self._followed(axis) as (state, news):
            return await until_ended(axis, command_id, state, news, self.outcome)

    async def wait_for_rest(self, axis: str, within_s: float | None = REST_S) -> StateSample:
        """Wait until an axis stands, and return its state then; see `until_at_rest`.

        Raises:
            OutcomeUnknown: the drive does not answer, or nothing comes from the axis any more.
            WrongState: it does not come to rest in time.
        """
        async with self._followed(axis) as (state, news):
            return await until_at_rest(axis, state, news, within_s)

    @asynccontextmanager
    async def _followed(
        self, axis: str
    ) -> AsyncIterator[tuple[Callable[[], StateSample | None], Callable[[], Awaitable[None]]]]:
        """Yield what returns the last state of an axis, and what returns once something has come from it."""
        async with self.samples(axis) as samples:
            last = await self.state(axis)

            async def news() -> None:
                nonlocal last
                _, sample = await anext(samples)
                last = sample if isinstance(sample, StateSample) else last

            yield lambda: last, news

    async def _unanswered(self, what: str) -> LdcndError:
        """Return the error for a command without an answer: absence, access control, or an answer that was lost.

        They look alike. A lease that does not exist cannot be renewed, which changes nothing; who is not permitted to
        command is not even refused that.
        """
        from ldcnd.contract.leases import Renew  # noqa: PLC0415 - clients that only read need no model of leases

        payload, encoding = encode(Renew(lease="none"), Encoding.MSGPACK)
        try:
            await self.daemon()
            heard = await self.session.query(self.keys.command(RIG_ITSELF, Renew.verb), payload, encoding=encoding)
        except SessionError:
            return OutcomeUnknown(f"{what}: no answer, and no daemon serves rig {self.rig} now")
        except OutcomeUnknown:
            return OutcomeUnknown(
                f"{what}: the daemon of rig {self.rig} does not answer; it may be carried out when it answers again"
            )
        if heard:
            return OutcomeUnknown(f"{what}: its answer was lost on the way; it may be carried out all the same")
        return SessionError(
            f"{what}: the daemon of rig {self.rig} is there but did not get it; this login is not permitted to command",
            remedy="use the login of an operator",
        )

    def _one(self, answers: list[Answer], model: type[ModelT]) -> ModelT:
        if not answers:
            raise SessionError(
                f"no daemon serves rig {self.rig}, or this login may not query it",
                remedy="check that the daemon runs and that you connect to it",
            )
        own = [answer for answer in answers if answer.source == self._origin.source]
        return self._decoded((own or answers)[-1], model)

    @staticmethod
    def _decoded(answer: Answer, model: type[ModelT]) -> ModelT:
        if answer.is_error:
            raise decode_error(answer.payload, answer.encoding)
        return decode_received(model, answer.payload, answer.encoding)


async def _until_heard(ask: Callable[[], Awaitable[list[Answer]]], timeout_s: float) -> list[Answer]:
    """Ask for what takes energy out, and again while no daemon hears it: a link that broke is soon made again.

    Sent twice it does what it does once. Where a daemon has answered, nothing is sent again.
    """
    loop = asyncio.get_running_loop()
    until_s = loop.time() + min(timeout_s, UNHEARD_S)
    while True:
        answers = await ask()
        if answers or loop.time() + ASK_AGAIN_S > until_s:
            return answers
        await asyncio.sleep(ASK_AGAIN_S)


def _of_everyone(answers: list[Answer]) -> Answer:
    """Return the answer to what was asked of all daemons of a rig, of which one has the line: what it achieved there.

    Another one that refuses, as at its end, hides no success, and no outcome that is not known.
    """
    accepted = [answer for answer in answers if not answer.is_error]
    unknown = (
        answer for answer in answers if isinstance(decode_error(answer.payload, answer.encoding), OutcomeUnknown)
    )
    return accepted[-1] if accepted else next(unknown, answers[-1])


async def find_rigs(session: Session) -> list[DaemonInfo]:
    """Return the daemons that can be reached, the one that was started last behind the others."""
    answers = await session.query(ALL_DAEMONS)
    found = (decode_received(DaemonInfo, answer.payload, answer.encoding) for answer in answers if not answer.is_error)
    return sorted(found, key=lambda daemon: daemon.started)


async def find_rig(session: Session, rig: str | None = None, at: Sequence[str] = ()) -> DaemonInfo:
    """Return the daemon of a rig.

    Args:
        session: where it is looked for.
        rig: which one; not needed when only one can be reached.
        at: the endpoints of the session, for the message.

    Raises:
        SessionError: no daemon answers, or none of this rig.
        UnknownAxis: several rigs can be reached and none was named.
    """
    daemons = {daemon.rig: daemon for daemon in await find_rigs(session)}
    there = f"there are: {', '.join(sorted(daemons))}"
    if not daemons:
        raise no_rig_answers(at)
    if rig is None and len(daemons) > 1:
        raise UnknownAxis(f"several rigs answer; {there}", remedy="name one of them: --rig, or `rig=` in Python")
    if rig is not None and rig not in daemons:
        near = next(iter(get_close_matches(rig, daemons, 1)), None)
        meant = f"; did you mean {near!r}?" if near else ""
        raise SessionError(f"no rig {rig!r} answers{meant}", value=rig, remedy=there)
    return daemons[rig] if rig else next(iter(daemons.values()))


def no_rig_answers(at: Sequence[str]) -> SessionError:
    """Return the error for a network without a rig; `at` are the endpoints."""
    return SessionError(
        f"no daemon answers at {', '.join(at) or 'the configured endpoints'}",
        remedy="start one with `ldcnd run`, or name its endpoint (--connect); a login without a role sees none either",
    )


def check_axes(rig: str, axes: Iterable[str], known: Iterable[str]) -> None:
    """Refuse axes that a rig does not have.

    Raises:
        UnknownAxis: for the first of them.
    """
    there = dict.fromkeys(known)
    for axis in axes:
        if axis not in there:
            raise UnknownAxis(f"rig {rig} has no axis {axis!r}; it has {', '.join(there)}", axis=axis, value=axis)


@asynccontextmanager
async def daemons(session: Session, on_daemon: OnDaemon) -> AsyncIterator[None]:
    """Tell of every daemon that can be reached, first of those that are there, for the time of the context."""

    def changed(key: str, alive: bool) -> None:  # noqa: FBT001 - a callback of the session
        keys = Keys.of(key)
        on_daemon(keys.rig, keys.parse_alive(key).instance, alive)

    declaration = await session.watch_tokens(ALL_RUNS, changed)
    try:
        yield
    finally:
        await declaration.close()


async def on_each_rig(
    session: Session, work: Callable[[RigClient], Awaitable[ResultT]]
) -> dict[str, ResultT | LdcndError]:
    """Do the same with every rig that can be reached, as soon as it shows itself: none waits for another.

    It shows itself by its liveliness token, which a frozen daemon has too, or by its answer.

    Args:
        session: where the rigs are.
        work: what is done; bounded in time.

    Returns:
        What came of it, or why it failed, by rig; empty when no rig can be reached.
    """

    async def outcome(rig: str) -> ResultT | LdcndError:
        try:
            return await work(RigClient(session, rig))
        except LdcndError as error:
            return error

    at_work: dict[str, asyncio.Task[ResultT | LdcndError]] = {}
    async with asyncio.TaskGroup() as group:

        def begin(rig: str) -> None:
            if rig not in at_work:
                at_work[rig] = group.create_task(outcome(rig), name=f"on {rig}")

        async with daemons(session, lambda rig, _, alive: begin(rig) if alive else None):
            with suppress(LdcndError):  # those that do not answer have shown their tokens
                for daemon in await find_rigs(session):
                    begin(daemon.rig)
    return {rig: at_work[rig].result() for rig in sorted(at_work)}
