"""The drive's own recorder as a `Tracer`: set up, armed, waited for, uploaded, put in order.

Settings are made before Data Trace Mode is entered and read back; afterwards the drive takes none (e=9). They are read
once more at the end: a drive that was switched off meanwhile is in its normal mode too, with nothing in its memory.
Source: manual 4; the order of the steps is that of the flowchart as far as it can be read.
"""

import asyncio
import math
from collections.abc import Mapping

from ldcnd.bus.bus import Bus
from ldcnd.bus.exchange_queue import Lane
from ldcnd.drivers.smartstep.addresses import Register, TraceRegister
from ldcnd.drivers.smartstep.commands import read_operating_mode, reference, write_trace_register
from ldcnd.drivers.smartstep.mode_switch import enter, execute_once, leave, require_idle
from ldcnd.drivers.smartstep.operating_modes import OperatingMode
from ldcnd.drivers.smartstep.parameters import PN202, PN203
from ldcnd.drivers.smartstep.profiles import SmartStepProfile, TriggerWordSource
from ldcnd.drivers.smartstep.trace_channels import (
    CHANNELS,
    Assignment,
    assign,
    trigger_condition,
    trigger_operand,
)
from ldcnd.drivers.smartstep.trace_memory import POINTS, first_point, require_pre_trigger
from ldcnd.drivers.smartstep.trace_result import TraceMemory, granted_channels, raw_columns, recorded
from ldcnd.drivers.smartstep.trace_scaling import TraceConstants
from ldcnd.drivers.smartstep.trace_setup import (
    LONGEST_INTERVAL,
    SHORTEST_INTERVAL,
    DataObject,
    duration_s,
    period_s,
    sampling_interval,
)
from ldcnd.drivers.smartstep.trace_upload import TraceUpload
from ldcnd.drivers.smartstep.words import Words
from ldcnd.drivers.tracer import ArmedTrace, Granted, Progress, Recorded, Tracer, TraceTimedOut, require_channels
from ldcnd.errors import DriveFault, ReplyTimeout, ValueOutOfRange
from ldcnd.model.requests import TraceRequest
from ldcnd.model.traces import TracePhase, TraceSource

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

    async def arm(self, request: TraceRequest) -> ArmedTrace:
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
            await execute_once(words)
        except BaseException:
            await leave(words)
            raise
        return armed

    async def disarm(self) -> bool:
        """See `Tracer`."""
        if await self._words.mode() != OperatingMode.DATA_TRACE:
            return False
        await enter(self._words, OperatingMode.NORMAL)
        return True

    def _require_possible(self, request: TraceRequest) -> None:
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
        request: TraceRequest,
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
