"""The traces of one axis: one at a time, armed in the axis's turn, recorded beside its commands, then published.

Armed in turn, so that no other setting of the drive comes between those of a trace; recorded in a task of its own, so
that commands, polls and stops go on meanwhile.
"""

import asyncio
from dataclasses import dataclass, field

from ldcnd.axis.clock import Clock
from ldcnd.contract.commands import AxisCommand, CommandReply, Verb
from ldcnd.contract.errors import (
    BusyTracing,
    InternalError,
    LdcndError,
    NotSupported,
    OutcomeUnknown,
    Remedy,
    TraceTimedOut,
    ValueOutOfRange,
    WrongState,
    step,
)
from ldcnd.contract.samples import Quality
from ldcnd.contract.traces import (
    AbortTrace,
    TakeTrace,
    TraceAbortReply,
    TraceChunk,
    TraceHeader,
    TracePhase,
    TraceReply,
)
from ldcnd.drives.tracer import ArmedTrace, Recorded, Tracer
from ldcnd.log import get_logger
from ldcnd.net.publisher import Publisher

log = get_logger("trace")

ABORT_S = 8.0
"""Longer than a drive's recorder may take to be left on a bad line."""
CHUNK_BYTES = 12_000
SAMPLE_BYTES = 16
NUMBER_BYTES = 22
"""The longest forms of an offset and of a number in JSON: a chunk stays below the longest payload."""


@dataclass(slots=True)
class _Trace:
    """One trace from its arming on.

    Attributes:
        header: as published last.
        started: set once cancelling its recording leaves nothing armed.
        ended: set once nothing is armed any more.
    """

    armed: ArmedTrace
    header: TraceHeader
    started: asyncio.Event = field(default_factory=asyncio.Event)
    ended: asyncio.Event = field(default_factory=asyncio.Event)


class TraceRecorder:
    """Arms, records, aborts and publishes the traces of one axis."""

    def __init__(self, axis: str, tracer: Tracer, publisher: Publisher, clock: Clock) -> None:
        self._axis = axis
        self._tracer = tracer
        self._publisher = publisher
        self._clock = clock
        self._current: _Trace | None = None
        self._armed: asyncio.Queue[_Trace] = asyncio.Queue(1)
        self._recording: asyncio.Task[Recorded | LdcndError] | None = None

    @property
    def channels(self) -> tuple[str, ...]:
        """The channels that can be recorded."""
        return self._tracer.channels

    @property
    def is_busy(self) -> bool:
        """Whether a trace is under way, its upload included."""
        return self._current is not None

    async def carry_out(self, command_id: str, command: AxisCommand[CommandReply]) -> CommandReply:
        """Arm or abort a trace; called by the axis in turn with its other commands.

        Raises:
            BusyTracing: a trace is under way.
            WrongState: there is nothing to abort.
            RequestRefused: it cannot be done; nothing was set.
            DriveFault: the drive declined.
            BusError: the line failed.
        """
        match command:
            case TakeTrace():
                return await self._arm(command_id, command)
            case AbortTrace():
                return await self._abort(command_id)
            case _:
                raise NotSupported(
                    f"axis {self._axis}: {command.verb} is not for traces", axis=self._axis, value=command.verb
                )

    def disconnected(self) -> None:
        """The line, or the drive's power, is gone."""
        self._tracer.disconnected()

    async def run(self) -> None:
        """Record what is armed, one trace after another, until cancelled."""
        while True:
            trace = await self._armed.get()
            try:
                await self._record(trace)
            finally:
                self._current = self._recording = None
                trace.ended.set()

    # -- commands ----------------------------------------------------------------------------------------------------

    async def _arm(self, command_id: str, request: TakeTrace) -> TraceReply:
        if self._current:
            raise BusyTracing(
                f"axis {self._axis}: trace {self._current.header.trace_id} is {self._current.header.phase.value}",
                axis=self._axis,
                value=self._current.header.trace_id,
                remedy=Remedy("wait for its end, or {}", step("trace_abort")),
            )
        self._check(request)
        armed = await self._tracer.arm(request)
        granted = armed.granted
        header = TraceHeader(
            t=self._clock.now_ns(),
            t_error_ns=0,
            seq=0,
            quality=Quality.UNCERTAIN,
            trace_id=command_id,
            axis=self._axis,
            source=self._tracer.source,
            phase=granted.phase,
            trigger=request.trigger,
            raw_columns=granted.raw_columns,
            **dict(granted.shape),
        )
        trace = self._current = _Trace(armed, header)
        # before the header of this one, so that no client takes samples of the last for its own
        self._publisher.withdraw_trace_chunks(self._axis)
        self._publish(trace, header)
        self._armed.put_nowait(trace)
        return TraceReply(
            command_id=command_id,
            axis=self._axis,
            verb=Verb.TRACE,
            trace_id=command_id,
            source=self._tracer.source,
            **dict(granted.shape),
        )

    def _check(self, request: TakeTrace) -> None:
        """Check the channels of a request, of its trigger and of its full scales.

        Raises:
            ValueOutOfRange: there is no such channel, one is named twice, or the trigger watches one that is not
                recorded.
            NotSupported: the full scale of a channel cannot be set.
        """
        axis, known = self._axis, self._tracer.channels
        for name in request.channels:
            if name not in known:
                raise ValueOutOfRange(
                    f"axis {axis}: cannot trace {name!r}; there are {', '.join(known)}", axis=axis, value=name
                )
        if len(set(request.channels)) < len(request.channels):
            raise ValueOutOfRange(f"axis {axis}: a channel is named twice: {', '.join(request.channels)}", axis=axis)
        if request.trigger and request.trigger.channel not in request.channels:
            raise ValueOutOfRange(
                f"axis {axis}: the trigger watches {request.trigger.channel!r}, which is not recorded",
                axis=axis,
                value=request.trigger.channel,
            )
        for name, full_scale in request.full_scale.items():
            if name not in self._tracer.full_scales:
                raise NotSupported(
                    f"axis {axis}: the full scale of {name!r} cannot be set",
                    axis=axis,
                    value=full_scale,
                    remedy="leave full_scale out",
                )

    async def _abort(self, command_id: str) -> TraceAbortReply:
        trace = self._current
        if trace is None:
            if not await self._tracer.disarm():
                raise WrongState(f"axis {self._axis}: no trace is under way", axis=self._axis)
        else:
            try:
                async with asyncio.timeout(ABORT_S):
                    await trace.started.wait()
                    if self._recording:
                        self._recording.cancel()
                    await trace.ended.wait()
            except TimeoutError:
                raise OutcomeUnknown(
                    f"axis {self._axis}: the drive did not leave its trace within {ABORT_S:g} s",
                    axis=self._axis,
                    remedy=Remedy("{} again", step("trace_abort")),
                ) from None
        return TraceAbortReply(
            command_id=command_id,
            axis=self._axis,
            verb=Verb.TRACE_ABORT,
            trace_id=trace.header.trace_id if trace else None,
        )

    # -- recording ---------------------------------------------------------------------------------------------------

    async def _record(self, trace: _Trace) -> None:
        """Record one trace; whatever befalls it ends in its header."""
        async with asyncio.TaskGroup() as group:
            recording = self._recording = group.create_task(self._outcome(trace), name=f"record {self._axis}")
        match None if recording.cancelled() else recording.result():
            case None:
                self._over(trace, TracePhase.ABORTED, None)
            case TraceTimedOut() as error:
                self._over(trace, TracePhase.TIMED_OUT, error)
            case LdcndError() as error:
                self._over(trace, TracePhase.FAILED, error)
            case Recorded() as recorded:
                await self._complete(trace, recorded)

    async def _outcome(self, trace: _Trace) -> Recorded | LdcndError:
        trace.started.set()

        def progress(phase: TracePhase, uploaded: float | None) -> None:
            self._publish(trace, trace.header.model_copy(update={"phase": phase, "uploaded": uploaded}))

        try:
            return await trace.armed.record(progress)
        except LdcndError as error:
            return error
        except Exception:
            log.exception("bug while tracing", axis=self._axis)
            return InternalError("an error inside ldcnd; its log has the details")

    def _over(self, trace: _Trace, phase: TracePhase, error: LdcndError | None) -> None:
        problem = error.message if error else None
        log.info("trace over", axis=self._axis, trace_id=trace.header.trace_id, phase=phase.value, reason=problem)
        self._publish(trace, trace.header.model_copy(update={"phase": phase, "uploaded": None, "problem": problem}))

    async def _complete(self, trace: _Trace, recorded: Recorded) -> None:
        """Publish the samples, then the header that says that they are there."""
        header = trace.header
        t, t_error_ns = self._clock.stamp_between(recorded.zero_from_s, recorded.zero_until_s)
        quality = Quality.UNCERTAIN if recorded.problems else Quality.GOOD
        size = _samples_per_chunk(len(recorded.values) + len(recorded.raw))
        firsts = range(0, len(recorded.offsets_ns), size)
        for index, first in enumerate(firsts):
            part = slice(first, first + size)
            chunk = TraceChunk(
                t=t + recorded.offsets_ns[first],
                t_error_ns=t_error_ns,
                seq=0,
                quality=quality,
                trace_id=header.trace_id,
                index=index,
                first=first,
                offsets_ns=recorded.offsets_ns[part],
                values=tuple(column[part] for column in recorded.values),
                raw=tuple(column[part] for column in recorded.raw),
            )
            self._publisher.publish_trace_chunk(self._axis, index, chunk)
            await asyncio.sleep(0)  # a long trace does not hold up the lines
        complete = {
            "t": t,
            "t_error_ns": t_error_ns,
            "quality": quality,
            "phase": TracePhase.COMPLETE,
            "uploaded": None,
            "problem": "; ".join(recorded.problems) or None,
            "samples": len(recorded.offsets_ns),
            "trigger_index": recorded.trigger_index,
            "trigger_late_s": recorded.trigger_late_s,
            "missed": recorded.missed,
            "chunks": len(firsts),
            "drive": recorded.drive,
        }
        self._publish(trace, header.model_copy(update=complete))
        log.info("trace complete", axis=self._axis, trace_id=header.trace_id, samples=len(recorded.offsets_ns))

    def _publish(self, trace: _Trace, header: TraceHeader) -> None:
        trace.header = header
        self._publisher.publish_trace(self._axis, header)


def _samples_per_chunk(columns: int) -> int:
    return CHUNK_BYTES // (SAMPLE_BYTES + NUMBER_BYTES * columns)
