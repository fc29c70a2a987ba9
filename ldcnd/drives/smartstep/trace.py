"""The drive's own recorder as a `Tracer`: set up, armed, waited for, uploaded.

Settings are made before Data Trace Mode is entered and read back; afterwards the drive takes none (e=9). They are read
once more at the end: a drive that was switched off meanwhile is in its normal mode too, with nothing in its memory. A
trace that is over sooner than its points take was ended from elsewhere and is none.

Where the bits of the drive's trigger are not known, the host polls the monitor of the channel and starts the trace when
the condition is met. The full scale of torque and speed can be lowered for one trace and is put back after it.
Source: manual 2.2, data string reference command; 4; the order of the steps is that of the flowchart as far as it can
be read.
"""

import asyncio
import contextlib
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

from typing_extensions import override

from ldcnd.contract.errors import (
    AddressRefused,
    DriveFault,
    LdcndError,
    NotSupported,
    ReplyTimeout,
    TraceTimedOut,
    ValueOutOfRange,
)
from ldcnd.contract.traces import TakeTrace, TracePhase, TraceShape, TraceSource, TraceTrigger
from ldcnd.drives.smartstep.addresses import OperatingMode, Register, TraceRegister
from ldcnd.drives.smartstep.commands import read_operating_mode, reference, write_trace_register
from ldcnd.drives.smartstep.modes import (
    LEAVE_S,
    end_mode,
    enter,
    execute_mode,
    leave,
    require_idle,
)
from ldcnd.drives.smartstep.monitors import signed_word
from ldcnd.drives.smartstep.parameters import PN202, PN203
from ldcnd.drives.smartstep.profiles import SmartStepProfile, TriggerWordSource
from ldcnd.drives.smartstep.trace_data import (
    LONGEST_INTERVAL,
    POINTS,
    SHORTEST_INTERVAL,
    DataObject,
    TraceConstants,
    period_s,
    require_pre_trigger,
    sampling_interval,
    scale,
)
from ldcnd.drives.smartstep.trace_data import first_point as ring_start
from ldcnd.drives.smartstep.trace_result import (
    CHANNELS,
    DATA,
    SIGNALS,
    TRIGGER_LATE_S,
    Assignment,
    ChannelMonitor,
    TraceMemory,
    assign,
    granted_channels,
    monitor_of,
    raw_columns,
    recorded,
    trigger_condition,
    trigger_operand,
    trigger_problem,
)
from ldcnd.drives.smartstep.trace_upload import TraceUpload
from ldcnd.drives.smartstep.words import Words
from ldcnd.drives.tracer import (
    ArmedTrace,
    Granted,
    Progress,
    Recorded,
    Tracer,
    TriggerWatch,
)
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Lane
from ldcnd.log import get_logger

log = get_logger("smartstep")

CHECK_PERIOD_S = 0.2
"""Pause between two readings of the operating mode, seconds."""
LAST_CHECK_PERIOD_S = 0.02
"""The same when the trace is about to end: what was ended from elsewhere just before differs from it then."""
GRACE_S = 1.0
LAST_READING_S = 5.0
"""Longest wait for the reading of the operating mode that decides whether a trace has finished, seconds."""
SLACK = 1.2
"""A drive's clock may be off, and its recorder may begin late."""
CLOCK_ERROR = 0.02
"""How far the clock of a drive may be off, as a fraction; the manual gives no accuracy."""
LARGEST_CYCLEC_US = 0xFFFF
FULL_SCALE_REGISTERS: Mapping[str, TraceRegister] = MappingProxyType(
    {"torque_reference": TraceRegister.MAXTRQC, "speed_feedback": TraceRegister.OSVELCC}
)


@dataclass(frozen=True, slots=True)
class _Setup:
    """The settings of a trace.

    Attributes:
        source: where its trigger comes from.
        originals: full scales to be put back, by their registers.
        problems: why its values will be uncertain.
    """

    request: TakeTrace
    assignment: Assignment
    settings: Mapping[TraceRegister, int]
    constants: TraceConstants
    source: TriggerWordSource
    originals: Mapping[TraceRegister, int]
    problems: tuple[str, ...]

    @property
    def interval_s(self) -> float:
        """The time between two points."""
        return period_s(self.settings[TraceRegister.SMPTMS], self.constants.cyclec_us)

    @property
    def trigger(self) -> TraceTrigger | None:
        """The trigger that the drive itself waits for."""
        return self.request.trigger if self.source is TriggerWordSource.CONFIGURED else None


class SmartStepTracer(Tracer):
    """See `Tracer`."""

    source = TraceSource.DRIVE
    channels = CHANNELS
    full_scales = frozenset(FULL_SCALE_REGISTERS)

    def __init__(self, bus: Bus, words: Words, profile: SmartStepProfile) -> None:
        self._bus = bus
        self._words = words
        self._profile = profile

    async def arm(self, request: TakeTrace) -> ArmedTrace:
        """See `Tracer`. Checks everything that needs no reply before the first exchange with the drive."""
        words, profile = self._words, self._profile
        assignment = assign(words.axis, request.channels)
        by_host = request.trigger is not None and profile.unit.trace.trigger_map is None
        no_word = TriggerWordSource.HOST if by_host else TriggerWordSource.NONE
        drives_trigger = None if by_host else request.trigger
        condition = trigger_condition(words.axis, profile, assignment, drives_trigger)
        pre_trigger = require_pre_trigger(request.pre_trigger) if request.trigger else 0
        self._require_possible(request, by_host=by_host)
        await require_idle(words)
        originals: dict[TraceRegister, int] = {}
        try:
            await self._set_full_scale(request, originals)
            constants, problems = await self._constants(request)
            smptms = SHORTEST_INTERVAL
            if request.interval_s != "fastest":
                smptms = sampling_interval(request.interval_s, constants.cyclec_us)
            first, second = assignment.objects
            settings = {
                TraceRegister.TRACE_1_OBJECT: first,
                TraceRegister.TRACE_2_OBJECT: second,
                TraceRegister.SMPTMS: smptms,
                TraceRegister.PTRGNO: pre_trigger,
                TraceRegister.TRGC1: condition,
                TraceRegister.TRGC2: trigger_operand(profile, constants, assignment, drives_trigger),
            }
            for register, value in settings.items():
                await words.ask(write_trace_register(words.unit, register, value))
            await require_settings(words, settings, Lane.COMMAND)
            setup = _Setup(
                request,
                assignment,
                settings,
                constants,
                profile.trigger_word if drives_trigger else no_word,
                originals,
                problems,
            )
            armed = ArmedSmartStep(self._bus, words, profile, setup)
            if not by_host:
                await armed.start()
        except BaseException:
            await put_back(words, originals)
            raise
        return armed

    async def disarm(self) -> bool:
        """See `Tracer`; a counter clear that was left behind ends, too, without clearing."""
        return await end_mode(self._words) is not None

    def _require_possible(self, request: TakeTrace, *, by_host: bool) -> None:
        """Refuse what no drive of this family can do.

        Raises:
            ValueOutOfRange: the number of samples, the interval, or points before a trigger that the host watches.
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
        if by_host and request.pre_trigger:
            raise ValueOutOfRange(
                f"axis {axis}: the trigger bits of the drive are not known, so the host starts the trace when it sees"
                f" the condition, and no sample comes before that; pre_trigger is {request.pre_trigger}",
                axis=axis,
                value=request.pre_trigger,
                limit=0,
                nearest=0,
                remedy="leave pre_trigger out, or configure smartstep.trace.trigger_map",
            )
        least_s, most_s = period_s(SHORTEST_INTERVAL, 1), period_s(LONGEST_INTERVAL, LARGEST_CYCLEC_US)
        if interval_s != "fastest" and not least_s / 2 <= interval_s <= most_s:
            raise ValueOutOfRange(
                f"axis {axis}: no drive samples every {interval_s} s",
                axis=axis,
                value=interval_s,
                nearest=min(max(interval_s, least_s), most_s),
            )

    async def _set_full_scale(self, request: TakeTrace, originals: dict[TraceRegister, int]) -> None:
        """Set the full scale of the requested channels; the previous values go into `originals`.

        Raises:
            NotSupported: the drive does not take it.
        """
        words = self._words
        for name, largest in request.full_scale.items():
            register = FULL_SCALE_REGISTERS[name]
            # 0 would leave nothing to scale by
            value = min(max(1, math.ceil(largest)), 0xFFFF)
            before = await words.read(register)
            if before == value:
                continue
            # before it is set: if that reply is lost, the register is put back all the same
            originals[register] = before
            try:
                await words.ask(write_trace_register(words.unit, register, value))
            except AddressRefused as refusal:
                # refused, so it has what it had
                del originals[register]
                raise NotSupported(
                    f"axis {words.axis}: the drive does not let {register.name} ({register:04X}H) be set",
                    axis=words.axis,
                    value=value,
                    remedy="leave full_scale out",
                ) from refusal

    async def _constants(self, request: TakeTrace) -> tuple[TraceConstants, tuple[str, ...]]:
        """Read what scales the values; the gear is that of the EEPROM (manual 4, RATB and RATA)."""
        words = self._words
        constants = [await words.read(each) for each in (Register.CYCLEC, Register.MAXTRQC, Register.OSVELCC)]
        gear, problems = [1, 1], []
        if any(DATA.get(name) is DataObject.COMMAND_PULSE_SPEED for name in request.channels):
            gear = [await words.read(each.eeprom_address) for each in (PN202, PN203)]
            for each, stored in zip((PN202, PN203), gear, strict=True):
                in_use = await words.read(each.ram_address)
                if in_use != stored:
                    problems.append(
                        f"{each.label} is {stored} in EEPROM and {in_use} in RAM: it is not known which is used"
                    )
        return TraceConstants(*constants, *gear), tuple(problems)


class ArmedSmartStep(ArmedTrace):
    """See `ArmedTrace`."""

    def __init__(
        self,
        bus: Bus,
        words: Words,
        profile: SmartStepProfile,
        setup: _Setup,
    ) -> None:
        """Prepare the trace.

        Args:
            bus: the owner of the line.
            words: the drive.
            profile: how it is taken to behave.
            setup: its settings.
        """
        request = setup.request
        self.granted = Granted(
            shape=TraceShape(
                channels=granted_channels(profile, setup.constants, setup.assignment),
                interval_s=setup.interval_s,
                samples=POINTS,
                pre_trigger=setup.settings[TraceRegister.PTRGNO],
            ),
            raw_columns=raw_columns(setup.assignment),
            phase=TracePhase.WAITING if request.trigger else TracePhase.RECORDING,
        )
        self._bus = bus
        self._words = words
        self._profile = profile
        self._setup = setup
        self._loop = asyncio.get_running_loop()
        self._sent_s = self._replied_s = self._running_at_s = self._loop.time()
        wait_s = request.timeout_s if setup.trigger else 0.0
        self._limit_s = wait_s + SLACK * POINTS * setup.interval_s + GRACE_S

    async def start(self) -> None:
        """Enter Data Trace Mode and execute it.

        Raises:
            OutcomeUnknown: every attempt got lost; the mode was left.
        """
        try:
            await enter(self._words, OperatingMode.DATA_TRACE)
            self._sent_s, self._replied_s = await execute_mode(self._words, OperatingMode.DATA_TRACE)
        except BaseException:
            await leave(self._words)
            raise
        self._running_at_s = self._sent_s

    @override
    async def record(self, progress: Progress) -> Recorded:
        words, setup = self._words, self._setup
        try:
            late_s = TRIGGER_LATE_S if setup.trigger else 0.0
            if setup.source is TriggerWordSource.HOST:
                late_s = await self._start_by_host(progress)
            ended_at_s = await self._wait_until_done()
            self._require_complete(ended_at_s)
            progress(TracePhase.UPLOADING, 0.0)
            await require_settings(words, setup.settings, Lane.BACKGROUND)
            memory = await self._memory(partial(progress, TracePhase.UPLOADING))
        except BaseException:
            await leave(words)
            await put_back(words, setup.originals)
            raise
        problems = () if await put_back(words, setup.originals) else ("the full scale could not be put back",)
        return self._result(memory, self._first_s(ended_at_s), late_s, problems)

    # -- a trigger by the host ---------------------------------------------------------------------------------------

    async def _start_by_host(self, progress: Progress) -> float:
        """Start the trace when the monitor of the channel meets the condition; return how late that may be.

        Raises:
            TraceTimedOut: it did not in the time of the request.
        """
        words, request = self._words, self._setup.request
        trigger = request.trigger
        if trigger is None:  # the source says otherwise
            return 0.0
        watch = TriggerWatch(trigger, signal=trigger.channel in SIGNALS)
        shown = monitor_of(trigger.channel)
        before_s = self._loop.time()
        try:
            async with asyncio.timeout(request.timeout_s):
                while True:
                    asked_s = self._loop.time()
                    word = await self._read(shown)
                    if word is not None:
                        if watch.fires(shown.value_of(word), ready=True):
                            break
                        before_s = asked_s
        except TimeoutError:
            raise TraceTimedOut(
                f"axis {words.axis}: the trigger did not come within {request.timeout_s:g} s", axis=words.axis
            ) from None
        await require_idle(words)
        await self.start()
        progress(TracePhase.RECORDING, None)
        return self._replied_s + self._setup.interval_s - before_s

    # -- recording ---------------------------------------------------------------------------------------------------

    async def _read(self, shown: ChannelMonitor) -> int | None:
        """Read a monitor; None when the line lost it or the drive has none."""
        try:
            return await self._words.ask(reference(self._words.unit, shown.monitor.address), Lane.BACKGROUND)
        except ReplyTimeout:
            return None

    async def _wait_until_done(self) -> float:
        """Return when the drive was seen in its normal mode; `_running_at_s` is when it was last seen tracing."""
        words = self._words
        deadline_s = self._loop.time() + self._limit_s
        try:
            # A busy line answers late; only a drive that still traces after its time has not finished.
            async with asyncio.timeout(self._limit_s + LAST_READING_S):
                while True:
                    asked_at_s = self._loop.time()
                    overdue = asked_at_s >= deadline_s
                    lane = Lane.COMMAND if overdue else Lane.BACKGROUND
                    try:
                        mode = await words.ask(read_operating_mode(words.unit), lane)
                    except ReplyTimeout:
                        mode = OperatingMode.DATA_TRACE  # a bad line does not end a trace
                    else:
                        if mode == OperatingMode.NORMAL:
                            return self._loop.time()
                        if overdue:
                            raise TimeoutError
                        self._running_at_s = asked_at_s
                    await asyncio.sleep(self._pause_s())
        except TimeoutError:
            waited = "the trigger did not come" if self._setup.trigger else "the drive did not finish"
            raise TraceTimedOut(
                f"axis {words.axis}: {waited} within {math.ceil(self._limit_s)} s", axis=words.axis
            ) from None

    def _pause_s(self) -> float:
        """Return the time to the next reading of the mode: short around the end, where it can be foreseen."""
        if self._setup.trigger:
            return CHECK_PERIOD_S
        ends_at_s = self._replied_s + POINTS * self._setup.interval_s
        return min(CHECK_PERIOD_S, max(LAST_CHECK_PERIOD_S, ends_at_s - 3 * LAST_CHECK_PERIOD_S - self._loop.time()))

    def _require_complete(self, ended_at_s: float) -> None:
        """Refuse a trace that was over before its points can have been taken.

        Raises:
            DriveFault: it was ended from elsewhere.
        """
        # those before the trigger may have been taken while it was waited for
        points = POINTS - self._setup.settings[TraceRegister.PTRGNO]
        needed_s = (points - 1) * self._setup.interval_s * (1 - CLOCK_ERROR)
        if ended_at_s - self._sent_s < needed_s:
            raise DriveFault(
                f"axis {self._words.axis}: the trace ended early, {ended_at_s - self._sent_s:.2f} s after its"
                f" start, although its points take {needed_s:.2f} s: it was ended from elsewhere",
                axis=self._words.axis,
                remedy="see who else uses the drive, and trace again",
            )

    # -- the result --------------------------------------------------------------------------------------------------

    async def _memory(self, read: Callable[[float], None]) -> TraceMemory:
        words, setup = self._words, self._setup
        address: int | None = None
        if setup.trigger:
            address = await words.ask(reference(words.unit, Register.TRGADR), Lane.BACKGROUND)
        first = 0 if address is None else ring_start(address, self.granted.shape.pre_trigger)
        upload = TraceUpload(self._bus, words, self._profile)
        used = setup.assignment.used

        def read_of(memory: int, share: float) -> None:
            read((memory + share) / used)

        rings = [await upload.fetch(memory + 1, partial(read_of, memory)) for memory in range(used)]
        return TraceMemory(tuple(rings), first, address, upload.string_checksum, setup.source)

    def _first_s(self, ended_at_s: float) -> tuple[float, float]:
        """Return between which instants the first sample was taken."""
        span_s = (POINTS - 1) * self._setup.interval_s
        from_s, until_s = self._running_at_s - span_s, ended_at_s - span_s
        if self._setup.trigger is None:
            # it also begins with its execution, whatever the drive's clock makes of the span
            began_from_s, began_until_s = self._sent_s, self._replied_s + self._setup.interval_s
            if max(from_s, began_from_s) <= min(until_s, began_until_s):
                return max(from_s, began_from_s), min(until_s, began_until_s)
        return from_s, until_s

    def _result(
        self, memory: TraceMemory, first_s: tuple[float, float], late_s: float, problems: tuple[str, ...]
    ) -> Recorded:
        setup, profile = self._setup, self._profile
        result = recorded(profile, setup.constants, setup.assignment, setup.settings, memory, first_s)
        trigger = setup.trigger
        if trigger and result.trigger_index is not None:
            column = result.values[setup.request.channels.index(trigger.channel)]
            missing = trigger_problem(trigger, self._level(trigger), column, result.trigger_index, setup.interval_s)
            problems += (missing,) if missing else ()
        return replace(
            result,
            zero_from_s=result.zero_from_s - (late_s if trigger else 0.0),
            trigger_late_s=late_s,
            problems=(*result.problems, *setup.problems, *problems),
        )

    def _level(self, trigger: TraceTrigger) -> float:
        """Return the trigger level as it was set in the drive, in the unit of the channel."""
        if trigger.channel in SIGNALS:
            return 0.0
        count = signed_word(self._setup.settings[TraceRegister.TRGC2])
        return count * scale(self._profile, self._setup.constants, DATA[trigger.channel])


async def put_back(words: Words, originals: Mapping[TraceRegister, int]) -> bool:
    """Set registers to what they were; bounded, whatever the line does. Return whether all of them are."""
    return all([await _put_back_one(words, register, value) for register, value in originals.items()])


async def _put_back_one(words: Words, register: TraceRegister, value: int) -> bool:
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(LEAVE_S):
            while True:
                try:
                    await words.ask(write_trace_register(words.unit, register, value))
                except ReplyTimeout:
                    continue
                except LdcndError as error:
                    log.error("register not put back", axis=words.axis, register=register.name, reason=error.message)
                    return False
                return True
    log.error("register not put back in time", axis=words.axis, register=register.name, value=value)
    return False


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
                " the drive was switched off, or another program uses its recorder",
                axis=words.axis,
                value=found,
                limit=value,
            )
