"""The drive's own recorder as a `Tracer`: set up, armed, waited for, uploaded, put in order.

Settings are made before Data Trace Mode is entered and read back; afterwards the drive takes none (e=9). They are read
once more at the end: a drive that was switched off meanwhile is in its normal mode too, with nothing in its memory.

The memory is read in pieces, each one exchange of the background lane, sent when the polls have caught up: a poller
that reads several words has its next one ready only a moment after the last, too late to go before a piece that waits
already. So a poll waits for one piece at most, unless the line has no time to spare: then a piece goes all the same,
but seldom. The checksum of a string may not cover its data, so a piece counts when two readings of it agree.
Source: manual 2.2, data string reference command; 4; the order of the steps is that of the flowchart as far as it can
be read.
"""

import asyncio
import contextlib
import math
from collections.abc import Mapping
from dataclasses import replace

from ldcnd.bus.bus import Bus
from ldcnd.bus.queue import Lane
from ldcnd.drivers.smartstep.addresses import OperatingMode, Register, TraceRegister
from ldcnd.drivers.smartstep.commands import (
    ChecksumPin,
    Refusal,
    StringReply,
    read_operating_mode,
    reference,
    string_reference,
    write_trace_register,
)
from ldcnd.drivers.smartstep.modes import end_mode, enter, execute_mode, leave, require_idle
from ldcnd.drivers.smartstep.parameters import PN202, PN203
from ldcnd.drivers.smartstep.profiles import SmartStepProfile, StringChecksum, TriggerWordSource
from ldcnd.drivers.smartstep.trace_data import (
    LONGEST_INTERVAL,
    POINTS,
    SHORTEST_INTERVAL,
    Chunk,
    DataObject,
    TraceConstants,
    chunk_plan,
    duration_s,
    first_point,
    period_s,
    require_pre_trigger,
    sampling_interval,
    split_words,
)
from ldcnd.drivers.smartstep.trace_result import (
    CHANNELS,
    Assignment,
    TraceMemory,
    assign,
    granted_channels,
    raw_columns,
    recorded,
    trigger_condition,
    trigger_operand,
)
from ldcnd.drivers.smartstep.words import Words
from ldcnd.drivers.tracer import ArmedTrace, Granted, Progress, Recorded, Tracer, TraceTimedOut, require_channels
from ldcnd.errors import BadReply, ByteCountRefused, DriveFault, ReplyTimeout, ValueOutOfRange
from ldcnd.exchange import Exchange
from ldcnd.model.traces import TakeTrace, TracePhase, TraceSource

ROUNDS = 4
"""So often a piece is read until two readings agree, and so often the bus's own attempts may fail."""

IDLE_LOOK_S = 0.005
LONGEST_REST_S = 5.0
"""On a line that is never idle a piece goes so often; some 700 characters in between are for others."""


class TraceUpload:
    """One upload; remembers what it has learnt of the drive's strings."""

    def __init__(self, bus: Bus, words: Words, profile: SmartStepProfile) -> None:
        self._bus = bus
        self._words = words
        self._profile = profile
        self._pin = ChecksumPin()

    @property
    def string_checksum(self) -> StringChecksum:
        """Which variant was found or is taken; AUTO while the replies leave a choice."""
        if self._profile.string_checksum is StringChecksum.AUTO:
            return self._pin.pinned
        return self._profile.string_checksum

    async def fetch(self, trace: int) -> tuple[int, ...]:
        """Return the words of trace memory 1 or 2, in the order of the memory.

        Raises:
            BadReply: the drive's strings are not as the profile says, or no two readings agree.
            DriveFault: the drive declined.
            BusError: the line failed.
        """
        data = b""
        for chunk in chunk_plan(trace, self._profile.trace_chunk_bytes):
            data += await self._fetch(chunk)
        return split_words(data, self._profile.trace_byte_order)

    async def _fetch(self, chunk: Chunk) -> bytes:
        """Return the bytes of a chunk, in smaller pieces when the drive refuses so many at once."""
        try:
            return await self._agreed(chunk)
        except ByteCountRefused:
            halves = chunk.halves()
            if halves is None:
                raise
        first, second = halves
        return await self._fetch(first) + await self._fetch(second)

    async def _agreed(self, chunk: Chunk) -> bytes:
        data = await self._read(chunk)
        if not self._profile.trace_verify:
            return data
        for _ in range(ROUNDS):
            again = await self._read(chunk)
            if again == data:
                return data
            data = again
        raise BadReply(
            f"axis {self._words.axis}: {chunk.byte_count} bytes at {chunk.address:04X}H read differently each time"
        )

    async def _read(self, chunk: Chunk) -> bytes:
        profile = replace(self._profile, string_checksum=self.string_checksum)
        exchange = string_reference(self._words.unit, chunk.address, chunk.byte_count, profile)
        for _ in range(ROUNDS - 1):
            with contextlib.suppress(ReplyTimeout):
                return await self._ask(exchange)
        return await self._ask(exchange)

    async def _ask(self, exchange: Exchange[StringReply | Refusal]) -> bytes:
        await self._wait_for_idle_line()
        reply = await self._words.ask(exchange, Lane.BACKGROUND)
        self._pin.take(reply)
        return reply.data

    async def _wait_for_idle_line(self) -> None:
        """Return when nothing was sent for a moment, or after the longest rest."""
        loop = asyncio.get_running_loop()
        at_the_latest_s = loop.time() + LONGEST_REST_S
        statistics = self._bus.statistics
        while loop.time() < at_the_latest_s:
            before = statistics.exchanges
            await asyncio.sleep(IDLE_LOOK_S)
            if self._bus.is_idle and statistics.exchanges == before:
                return


LOOK_S = 0.2
"""Pause between two looks at the operating mode."""
GRACE_S = 1.0
SLACK = 1.2
"""A drive's clock may be off, and its recorder may begin late."""
LARGEST_CYCLEC_US = 0xFFFF


class SmartStepTracer(Tracer):
    """See `Tracer`."""

    source = TraceSource.DRIVE
    channels = CHANNELS

    def __init__(self, bus: Bus, words: Words, profile: SmartStepProfile) -> None:
        self._bus = bus
        self._words = words
        self._profile = profile

    async def arm(self, request: TakeTrace) -> ArmedTrace:
        """See `Tracer`. Nothing is asked of the drive before everything that it need not say is in order."""
        words, profile = self._words, self._profile
        require_channels(words.axis, request, self.channels)
        assignment = assign(words.axis, request.channels)
        condition = trigger_condition(words.axis, profile, assignment, request.trigger)
        pre_trigger = require_pre_trigger(request.pre_trigger) if request.trigger else 0
        self._require_possible(request)
        await require_idle(words)
        constants = await self._constants(assignment)
        smptms = SHORTEST_INTERVAL
        if request.interval_s != "fastest":
            smptms = sampling_interval(request.interval_s, constants.cyclec_us)
        first, second = assignment.objects
        settings = {
            TraceRegister.TRACE_1_OBJECT: first,
            TraceRegister.TRACE_2_OBJECT: second,
            TraceRegister.SMPTMS: smptms,
            TraceRegister.PTRGNO: pre_trigger,
            TraceRegister.TRGC1: condition.word,
            TraceRegister.TRGC2: trigger_operand(profile, constants, assignment, request.trigger),
        }
        for register, value in settings.items():
            await words.ask(write_trace_register(words.unit, register, value))
        await require_settings(words, settings, Lane.COMMAND)
        armed = ArmedSmartStep(self._bus, words, profile, request, assignment, settings, constants, condition.source)
        try:
            await enter(words, OperatingMode.DATA_TRACE)
            await execute_mode(words, OperatingMode.DATA_TRACE)
        except BaseException:
            await leave(words)
            raise
        return armed

    async def disarm(self) -> bool:
        """See `Tracer`."""
        return await end_mode(self._words) is not None

    def _require_possible(self, request: TakeTrace) -> None:
        """Refuse what no drive of this family can do.

        Raises:
            ValueOutOfRange: so many samples, or such an interval.
        """
        axis, interval_s = self._words.axis, request.interval_s
        if request.samples > POINTS:
            raise ValueOutOfRange(
                f"axis {axis}: {request.samples} samples; the drive has room for {POINTS}",
                axis=axis,
                value=request.samples,
                limit=POINTS,
                nearest=POINTS,
            )
        least_s, most_s = period_s(SHORTEST_INTERVAL, 1), period_s(LONGEST_INTERVAL, LARGEST_CYCLEC_US)
        if interval_s != "fastest" and not least_s / 2 <= interval_s <= most_s:
            raise ValueOutOfRange(
                f"axis {axis}: no drive samples every {interval_s} s",
                axis=axis,
                value=interval_s,
                nearest=min(max(interval_s, least_s), most_s),
            )

    async def _constants(self, assignment: Assignment) -> TraceConstants:
        words = self._words
        constants = [await words.read(each) for each in (Register.CYCLEC, Register.MAXTRQC, Register.OSVELCC)]
        gear = [1, 1]
        if DataObject.COMMAND_PULSE_SPEED in assignment.data:
            gear = [await words.read(each.ram_address) for each in (PN202, PN203)]
        return TraceConstants(*constants, *gear)


class ArmedSmartStep(ArmedTrace):
    """See `ArmedTrace`."""

    def __init__(
        self,
        bus: Bus,
        words: Words,
        profile: SmartStepProfile,
        request: TakeTrace,
        assignment: Assignment,
        settings: Mapping[TraceRegister, int],
        constants: TraceConstants,
        source: TriggerWordSource,
    ) -> None:
        smptms = settings[TraceRegister.SMPTMS]
        self.granted = Granted(
            channels=granted_channels(profile, constants, assignment),
            raw_columns=raw_columns(assignment),
            interval_s=period_s(smptms, constants.cyclec_us),
            samples=POINTS,
            pre_trigger=settings[TraceRegister.PTRGNO],
            phase=TracePhase.WAITING if request.trigger else TracePhase.RECORDING,
        )
        self._bus = bus
        self._words = words
        self._profile = profile
        self._assignment = assignment
        self._settings = settings
        self._constants = constants
        self._source = source
        self._triggered = request.trigger is not None
        self._loop = asyncio.get_running_loop()
        self._running_at_s = self._loop.time()
        wait_s = request.timeout_s if self._triggered else 0.0
        self._limit_s = wait_s + SLACK * duration_s(smptms, constants.cyclec_us) + GRACE_S

    async def record(self, progress: Progress) -> Recorded:
        """See `ArmedTrace`."""
        words = self._words
        try:
            ended_at_s = await self._wait_until_done()
        except BaseException:
            await leave(words)
            raise
        progress(TracePhase.UPLOADING)
        await require_settings(words, self._settings, Lane.BACKGROUND)
        address: int | None = None
        if self._triggered:
            address = await words.ask(reference(words.unit, Register.TRGADR), Lane.BACKGROUND)
        first = 0 if address is None else first_point(address, self.granted.pre_trigger)
        upload = TraceUpload(self._bus, words, self._profile)
        rings = [await upload.fetch(memory + 1) for memory in range(self._assignment.used)]
        memory = TraceMemory(tuple(rings), first, address, upload.string_checksum, self._source)
        return recorded(
            self._profile,
            self._constants,
            self._assignment,
            self._settings,
            memory,
            (self._running_at_s, ended_at_s),
        )

    async def _wait_until_done(self) -> float:
        """Return when the drive was seen in its normal mode; `_running_at_s` is when it was last seen tracing."""
        words = self._words
        try:
            async with asyncio.timeout(self._limit_s):
                while True:
                    asked_at_s = self._loop.time()
                    try:
                        mode = await words.ask(read_operating_mode(words.unit), Lane.BACKGROUND)
                    except ReplyTimeout:
                        mode = OperatingMode.DATA_TRACE  # a bad line does not end a trace
                    else:
                        if mode == OperatingMode.NORMAL:
                            return self._loop.time()
                        self._running_at_s = asked_at_s
                    await asyncio.sleep(LOOK_S)
        except TimeoutError:
            waited = "the trigger did not come" if self._triggered else "the drive did not finish"
            raise TraceTimedOut(
                f"axis {words.axis}: {waited} within {math.ceil(self._limit_s)} s", axis=words.axis
            ) from None


async def require_settings(words: Words, settings: Mapping[TraceRegister, int], lane: Lane) -> None:
    """Read the settings of a trace back.

    Raises:
        DriveFault: the drive has others.
    """
    for register, value in settings.items():
        found = await words.ask(reference(words.unit, register), lane)
        if found != value:
            raise DriveFault(
                f"axis {words.axis}: {register.name} is {found:04X}H, not {value:04X}H as it was set;"
                " the drive was switched off, or somebody else uses its recorder",
                axis=words.axis,
                value=found,
                limit=value,
            )
