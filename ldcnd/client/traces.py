"""Taking a trace and fetching it whole."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass

from ldcnd.client.notebook import panes
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.errors import DriveFault, LdcndError, OutcomeUnknown, Remedy, TraceTimedOut, WrongState, step
from ldcnd.contract.traces import AbortTrace, TakeTrace, TraceChunk, TraceHeader, TracePhase, TraceReply

CHECK_PERIOD_S = 0.1
ENDING_S = 10.0
UNDER_WAY = frozenset({TracePhase.FILLING, TracePhase.WAITING, TracePhase.RECORDING, TracePhase.UPLOADING})


@dataclass(frozen=True, slots=True)
class Trace:
    """A complete trace; columns are as long as `offsets_ns`.

    Attributes:
        header: what it is.
        offsets_ns: when each sample was true, relative to the header's `t`.
        values: a column for each of the header's channels.
        raw: a column for each of the header's raw columns.
    """

    header: TraceHeader
    offsets_ns: tuple[int, ...]
    values: tuple[tuple[float | None, ...], ...]
    raw: tuple[tuple[int | float | None, ...], ...]

    def _repr_html_(self) -> str:
        """Return its channels as curves, for notebooks."""
        seconds = [offset / 1e9 for offset in self.offsets_ns]
        titles = (f"{each.name.replace('_', ' ')} [{each.unit}]" for each in self.header.channels)
        span = f"{len(seconds)} samples in {seconds[-1] - seconds[0]:.3g} s" if seconds else "no samples"
        return panes(span, seconds, zip(titles, self.values, strict=True))


async def trace_header(client: RigClient, axis: str) -> TraceHeader | None:
    """Return how far an axis's last trace is, or None when there was none."""
    headers = await client.read(client.keys.trace(axis), TraceHeader)
    return headers[0] if headers else None


async def trace_chunk(client: RigClient, axis: str, index: int) -> TraceChunk | None:
    """Return samples of an axis's last trace, or None when it has no such chunk."""
    chunks = await client.read(client.keys.trace_chunk(axis, index), TraceChunk)
    return chunks[0] if chunks else None


async def take_trace(client: RigClient, axis: str, request: TakeTrace, within_s: float) -> Trace:
    """Arm a trace, wait for its end, and return it; when cancelled meanwhile, end it.

    Args:
        client: of the rig.
        axis: to be traced.
        request: what to record.
        within_s: longest wait from its arming to its end.

    Raises:
        LdcndError: the daemon refused it.
        DriveFault: it did not complete; says why.
        OutcomeUnknown: it did not end in time, or gave way to another one; it may still be under way.
    """
    async with armed_trace(client, axis, request) as reply:
        await wait_for_trace(client, axis, reply.trace_id, within_s)
        return await fetch_trace(client, axis, reply.trace_id)


async def arm_trace(client: RigClient, axis: str, request: TakeTrace) -> TraceReply:
    """Arm a trace and return what it will be."""
    return await client.command(axis, request)


@asynccontextmanager
async def armed_trace(client: RigClient, axis: str, request: TakeTrace) -> AsyncIterator[TraceReply]:
    """Arm a trace that is ended when the context is cancelled or waits no longer; yields what it will be.

    Raises:
        LdcndError: the daemon refused it.
    """
    reply = await arm_trace(client, axis, request)
    try:
        yield reply
    except (asyncio.CancelledError, OutcomeUnknown):
        with suppress(LdcndError):  # out of reach: it ends by itself
            await _end(client, axis, reply.trace_id)
        raise


async def _end(client: RigClient, axis: str, trace_id: str) -> None:
    """End a trace, unless it has ended or given way to another one."""
    header = await trace_header(client, axis)
    if header and header.trace_id == trace_id and header.phase in UNDER_WAY:
        await client.command(axis, AbortTrace(), ENDING_S)


async def wait_for_trace(
    client: RigClient,
    axis: str,
    trace_id: str,
    within_s: float,
    progress: Callable[[TraceHeader], None] = lambda _: None,
) -> TraceHeader:
    """Wait for the end of a trace, good or bad; `progress` is called with how far it is.

    Raises:
        OutcomeUnknown: it did not end in time, or gave way to another one.
    """
    try:
        async with asyncio.timeout(within_s):
            while True:
                header = await _header(client, axis, trace_id)
                if header.phase not in UNDER_WAY:
                    return header
                progress(header)
                await asyncio.sleep(CHECK_PERIOD_S)
    except TimeoutError:
        raise OutcomeUnknown(
            f"axis {axis}: trace {trace_id} did not end within {within_s:g} s",
            axis=axis,
            remedy=Remedy("{}", step("trace_abort")),
        ) from None


async def fetch_trace(client: RigClient, axis: str, trace_id: str | None = None) -> Trace:
    """Return a complete trace: the last one, which must be this one if an id is given.

    Raises:
        WrongState: there is none, or it is under way.
        DriveFault: it did not complete; says why.
        OutcomeUnknown: it gave way to another one.
    """
    header = await _header(client, axis, trace_id)
    if header.phase in UNDER_WAY:
        raise WrongState(
            f"axis {axis}: trace {header.trace_id} is {header.phase.value}: it is not complete yet",
            axis=axis,
            value=header.phase.value,
            remedy=Remedy("wait for its end, or {}", step("trace_abort")),
        )
    if header.phase is not TracePhase.COMPLETE:
        failed = TraceTimedOut if header.phase is TracePhase.TIMED_OUT else DriveFault
        raise failed(
            f"axis {axis}: trace {header.trace_id} is {header.phase.value}: {header.problem or 'it has no samples'}",
            axis=axis,
            value=header.phase.value,
        )
    chunks = [await _chunk(client, axis, header.trace_id, index) for index in range(header.chunks)]
    return Trace(
        header,
        tuple(offset for chunk in chunks for offset in chunk.offsets_ns),
        tuple(tuple(v for chunk in chunks for v in chunk.values[column]) for column in range(len(header.channels))),
        tuple(tuple(v for chunk in chunks for v in chunk.raw[column]) for column in range(len(header.raw_columns))),
    )


async def _header(client: RigClient, axis: str, trace_id: str | None) -> TraceHeader:
    header = await trace_header(client, axis)
    if header is None:
        raise WrongState(f"axis {axis}: there is no trace", axis=axis)
    if trace_id not in (None, header.trace_id):
        raise _replaced(axis, trace_id)
    return header


async def _chunk(client: RigClient, axis: str, trace_id: str, index: int) -> TraceChunk:
    chunk = await trace_chunk(client, axis, index)
    if chunk is None or chunk.trace_id != trace_id:
        raise _replaced(axis, trace_id)
    return chunk


def _replaced(axis: str, trace_id: str | None) -> OutcomeUnknown:
    return OutcomeUnknown(f"axis {axis}: trace {trace_id} gave way to another one", axis=axis)
