"""An axis as a motor record: its fields, and what puts to them do.

Fields follow the motor record of the EPICS collaboration. What the gateway cannot do has no field, such as retries.
"""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from contextlib import AbstractAsyncContextManager, suppress
from functools import partial

from caproto import AlarmSeverity, AlarmStatus

from ldcnd.client.axis import Axis
from ldcnd.client.motion import Motion, Sent
from ldcnd.contract.commands import BufferMode, Verb
from ldcnd.contract.condition import Alarm as Severity
from ldcnd.contract.condition import assess
from ldcnd.contract.errors import (
    CommandAborted,
    LdcndError,
    LeaseRequired,
    PositionLimit,
    RequestRefused,
    ValueOutOfRange,
    WrongState,
)
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.samples import (
    AdcSample,
    AxisState,
    FaultSample,
    InputsSample,
    LinkState,
    MonitorSample,
    Moving,
    PositionSample,
    Quality,
    Sample,
    StateSample,
    TelemetryItem,
    VelocitySample,
)
from ldcnd.lab.epics.fields import (
    NO_ALARM,
    Action,
    Put,
    RecordAlarm,
    RecordField,
    Value,
    choice,
    integer,
    number,
    string,
    text,
)

NO_HOLDER = "none"
"""Shown as who controls an axis while this gateway does not and was not refused."""
NO_LIMIT = 1e30
"""Stands for a missing limit when the other one is set; both 0 stand for none, as in the motor record."""
REST_S = 10.0
"""Longest wait for the standstill after a motion that was ended early, in seconds."""
SILENT = RecordAlarm(AlarmStatus.COMM, AlarmSeverity.INVALID_ALARM)
UNDEFINED = RecordAlarm(AlarmStatus.UDF, AlarmSeverity.INVALID_ALARM)
QUALITIES = {
    Quality.GOOD: NO_ALARM,
    Quality.UNCERTAIN: RecordAlarm(AlarmStatus.SOFT, AlarmSeverity.MINOR_ALARM),
    Quality.BAD: SILENT,
}
ALARMS = {
    Severity.NONE: NO_ALARM,
    Severity.MINOR: RecordAlarm(AlarmStatus.STATE, AlarmSeverity.MINOR_ALARM),
    Severity.MAJOR: RecordAlarm(AlarmStatus.STATE, AlarmSeverity.MAJOR_ALARM),
    Severity.INVALID: SILENT,
}
INPUTS = ("forward_limit", "reverse_limit", "index", "stop_input", "amplifier_enable")
SEVERITIES = ("NO_ALARM", "MINOR", "MAJOR", "INVALID")
DESCRIBED = (*("EGU", "PREC", "HLM", "LLM", "DHLM", "DLLM", "VMAX", "MRES", "ERES", "UREV", "BDST", "OUT", "DESC"),)
"""Fields that say what the axis is."""
MSTA_PLUS, MSTA_DONE, MSTA_POSITION, MSTA_PROBLEM, MSTA_MOVING, MSTA_COMM = 0x1, 0x2, 0x100, 0x200, 0x400, 0x1000
MSTA_GAIN, MSTA_HOMED, MSTA_HIGH_SWITCH, MSTA_LOW_SWITCH = 0x800, 0x4000, 0x4, 0x2000
"""Bits of MSTA that the gateway supports."""


class MotorRecord:
    """One axis; its fields are in `fields`, by the names of their process variables behind the prefix.

    Args:
        info: what the axis is.
        defaults: its velocity and acceleration, in units a second and a second squared, when a client names no others.
        start: keeps a task until its end.
        watch: gives the axis without control of it, for what takes energy out.
        clients: returns who is connected: a jog ends when one of them is gone.
        moves: whether puts move it at all.
    """

    def __init__(
        self,
        info: AxisInfo,
        defaults: tuple[float, float],
        start: Callable[[Coroutine[object, object, None], str], asyncio.Future[None]],
        watch: Callable[[str], AbstractAsyncContextManager[Axis]],
        clients: Callable[[], frozenset[object]],
        *,
        moves: bool,
    ) -> None:
        self.info = info
        self._axis: Axis | None = None
        self._is_refused = False  # another program had control when this one asked for it, or took it
        self._control_wanted = asyncio.Event()
        self._control_changed = asyncio.Event()
        self._used_s = 0.0  # when a put needed control last, in loop time
        self._start = start
        self._watch = watch
        self._clients = clients
        self._pending = 0
        self._jog_puts = 0
        self._halts = 0  # puts so far that halt: a motion that was put before one does not begin after it
        self._wanted: float | None = None  # the newest target that was put and has no reply yet
        self._waiting: asyncio.Future[Put] | None = None  # what sends it once those before it have a reply
        self._turn = asyncio.Lock()
        self._sent: Sent | None = None
        self._state: StateSample | None = None
        self._moving = Moving.UNKNOWN
        self._changed = asyncio.Event()
        self._released = asyncio.Event()  # the jog under way is to end
        self._jogging: asyncio.Future[None] | None = None
        self._alarm = SILENT
        self._faults: FaultSample | None = None
        self._condition = assess(None)
        self._switches = 0  # bits of MSTA
        self.fields: dict[str, RecordField] = self._made(info, *defaults)
        self._val = self["VAL"]
        self._defaults = defaults
        if moves:
            self._let_move()

    # -- fields ------------------------------------------------------------------------------------------------------

    @staticmethod
    def _made(info: AxisInfo, velocity: float, acceleration: float) -> dict[str, RecordField]:
        unit = info.unit
        low, high = info.limits.position_min, info.limits.position_max
        limits = (0.0, 0.0) if low is None and high is None else (_or(low, -NO_LIMIT), _or(high, NO_LIMIT))
        step = 1.0 / info.counts_per_unit if info.counts_per_unit else 1.0
        precision = max(0, min(9, len(f"{step:.9f}".rstrip("0").partition(".")[2])))

        def here(value: float = 0.0, limits: tuple[float, float] = (0.0, 0.0)) -> RecordField:
            return number(value, unit, precision=precision, limits=limits)

        target = here(limits=limits)
        record: dict[str, RecordField] = {
            "VAL": target,
            "DVAL": target,  # dial and user values are the same: OFF is 0 and DIR is Pos
            "RBV": here(),
            "DRBV": here(),
            "RRBV": integer(),
            "DMOV": integer(1),
            "MOVN": integer(),
            "TDIR": integer(),
            "MSTA": integer(),
            "VELO": number(velocity, f"{unit}/s", precision=precision),
            "VMAX": number(info.limits.velocity or 0.0, f"{unit}/s", precision=precision),
            "VBAS": number(0.0, f"{unit}/s", precision=precision),
            "HVEL": number(0.0, f"{unit}/s", precision=precision),
            "ACCL": number(velocity / acceleration, "s", precision=3),
            "HLM": here(limits[1]),
            "LLM": here(limits[0]),
            "DHLM": here(limits[1]),
            "DLLM": here(limits[0]),
            "HLS": integer(),
            "LLS": integer(),
            "LVIO": integer(),
            "EGU": string(unit),
            "PREC": integer(precision),
            "MRES": number(step, unit, precision=9),
            "ERES": number(step, unit, precision=9),
            "SREV": integer(1),
            "UREV": number(step, unit, precision=9),
            "RDBD": here(0.0),
            "BDST": here(info.approach or 0.0),
            "OUT": string(f"{info.bus} {info.address}"),
            "DESC": string(f"{info.axis}, {info.model}"),
            "RTYP": string("motor"),
            "STAT": string("NO_ALARM"),
            "SEVR": choice("INVALID", *SEVERITIES),
            "STOP": integer(),
            "SPMG": choice("Go", "Stop", "Pause", "Move", "Go"),
            "HOMF": integer(),
            "HOMR": integer(),
            "JOGF": integer(),
            "JOGR": integer(),
            "JVEL": number(velocity, f"{unit}/s", precision=precision),
            "TWV": here(1.0),
            "TWF": integer(),
            "TWR": integer(),
            "SET": choice("Use", "Use", "Set"),
            "OFF": here(0.0),
            "FOFF": choice("Frozen", "Variable", "Frozen"),
            "DIR": choice("Pos", "Pos", "Neg"),
            "CNEN": choice("Disable", "Disable", "Enable"),
        }
        name = info.axis
        fields = {f"{name}.{field}": channel for field, channel in record.items()}
        fields |= {
            name: target,
            f"{name}:state": string(),
            f"{name}:condition": text(),
            f"{name}:velocity": number(0.0, f"{unit}/s", precision=precision),
            f"{name}:faults": text(),
            f"{name}:first_fault": string(),
            f"{name}:message": text(),
            f"{name}:reset": integer(),
            f"{name}:control": string(NO_HOLDER),
        }
        if info.adc_full_scale:
            fields[f"{name}:adc"] = number(0.0, "V")
        for monitor in info.monitors:
            fields[f"{name}:{monitor}"] = number(0.0, precision=0)
        if "input_signals" in info.monitors or TelemetryItem.INPUTS in info.items:
            fields[f"{name}:inputs"] = text()
        return fields

    def _let_move(self) -> None:
        can = set(self.info.capabilities)
        actions: dict[str, Action] = {"STOP": self._put_stop, "SPMG": self._put_spmg}
        if Verb.MOVE_ABSOLUTE in can:
            actions |= {
                "VAL": self._put_val,
                "TWV": self._keep,
                "TWF": lambda asked: self._put_tweak(asked, 1),
                "TWR": lambda asked: self._put_tweak(asked, -1),
                "VELO": self._put_velo,
                "ACCL": self._put_positive,
                "SET": self._keep,
            }
        if Verb.JOG in can:
            actions |= {
                "JOGF": lambda asked: self._put_jog(asked, "JOGF", 1),
                "JOGR": lambda asked: self._put_jog(asked, "JOGR", -1),
                "JVEL": self._put_velo,
            }
        if Verb.HOME in can:
            actions |= {
                "HVEL": self._put_positive,
                "HOMF": lambda asked: self._put_home(asked, 1),
                "HOMR": lambda asked: self._put_home(asked, -1),
            }
        if Verb.POWER in can:
            actions["CNEN"] = self._put_cnen
        for field, action in actions.items():
            self[field].action = self._explained(action)
        reset = self.beside("reset")
        if Verb.RESET in can and reset is not None:
            reset.action = self._explained(self._put_reset)

    def __getitem__(self, field: str) -> RecordField:
        return self.fields[f"{self.info.axis}.{field}"]

    async def describe(self, info: AxisInfo, defaults: tuple[float, float]) -> None:
        """Take what the axis is from now on: its daemon was reloaded or restarted.

        After a change of unit nothing moves until Go is put to SPMG: numbers of clients may be in the former one.
        """
        before, fresh = self.info, self._made(info, *defaults)
        is_other_unit = info.unit != before.unit
        described = {f"{info.axis}.{field}" for field in DESCRIBED}
        highest = info.limits.velocity or NO_LIMIT
        if is_other_unit or defaults != self._defaults or float(self["VELO"].value) > highest:
            described |= {f"{info.axis}.{field}" for field in ("VELO", "JVEL", "ACCL")}
        if is_other_unit:
            if self["SPMG"].action:
                await self["SPMG"].show("Stop")
            self._sent, self._state = None, None
            await self.silent()  # what is shown is of the former daemon
            await self._show_beside(
                "message", f"its unit is {info.unit} now and was {before.unit}: put Go to SPMG to let it move"
            )
        self.info, self._defaults = info, defaults
        for name, channel in self.fields.items():
            if name in fresh:
                await channel.redescribe(fresh[name])
                if name in described:
                    await channel.show(fresh[name].value)

    def beside(self, name: str) -> RecordField | None:
        """Return a variable beside the record, such as `adc`."""
        return self.fields.get(f"{self.info.axis}:{name}")

    # -- what the axis says ------------------------------------------------------------------------------------------

    async def take(self, sample: Sample, item: str = "") -> None:
        """Show a sample; the item names monitors."""
        alarm, at_s = QUALITIES[sample.quality], sample.t * 1e-9
        match sample:
            case PositionSample() if sample.unit != self.info.unit:
                await self["RBV"].show(self["RBV"].value, SILENT)  # of a daemon that is not described here yet
            case PositionSample():
                worst = max(alarm, self._alarm, key=lambda each: each.severity)
                for field in ("RBV", "DRBV"):
                    await self[field].show(sample.value, worst, at_s)
                await self["RRBV"].show(sample.counts, worst, at_s)
                await self._show_target()
            case VelocitySample():
                await self._show_beside("velocity", sample.value, alarm, at_s)
                if sample.value:
                    await self["TDIR"].show(int(sample.value > 0))
            case AdcSample():
                await self._show_beside("adc", sample.volts, alarm, at_s)
            case InputsSample():
                await self._take_inputs(sample, alarm, at_s)
            case FaultSample():
                self._faults = sample
                await self._show_beside("faults", "\n".join(f"{each.code}: {each.text}" for each in sample.active))
                await self._show_beside("first_fault", sample.first.code if sample.first else "")
            case StateSample():
                await self._take_state(sample)
            case MonitorSample():
                await self._show_beside(item, sample.value, alarm, at_s)
                if item == "input_signals":
                    await self._show_beside(
                        "inputs", ", ".join(sample.active if sample.active is not None else sample.high)
                    )

    async def _show_target(self) -> None:
        """Show where the axis was sent, by whomever, or else where it is, unless a put is on its way."""
        state = self._state
        if self._wanted is not None or state is None:
            return
        target = self._sent.target(state) if self._sent else state.target
        await self._val.show(self["RBV"].value if target is None else target)

    async def _take_state(self, sample: StateSample) -> None:
        self._moving, self._state = sample.moving, sample
        self._changed.set()
        self._condition = assess(sample, self._faults)
        before, self._alarm = self._alarm, ALARMS[self._condition.alarm]
        if sample.moving is Moving.UNKNOWN:
            self._alarm = SILENT
        await self._show_beside("condition", ", ".join(self._condition.notes))
        if self._alarm != before:  # no position may come that would carry it
            for field in ("RBV", "DRBV", "RRBV"):
                await self[field].show(self[field].value, self._alarm)
        await self._show_beside("state", sample.state.value + (", stop latched" if sample.stop_latched else ""))
        await self["CNEN"].show("Enable" if sample.enabled else "Disable")
        await self["MSTA"].show(
            (MSTA_DONE if sample.moving is Moving.NO else MSTA_MOVING)
            | self._switches
            | MSTA_GAIN * sample.enabled
            | MSTA_HOMED * sample.referenced
            | MSTA_PROBLEM * (sample.state is AxisState.ERROR_STOP)
            | MSTA_COMM * (sample.link is LinkState.DOWN)
        )
        await self._show_target()
        await self.show_motion()

    async def _take_inputs(self, sample: InputsSample, alarm: RecordAlarm, at_s: float) -> None:
        """Show inputs, and the switches at both ends of the axis; a drive may not show them for a while."""
        active = ", ".join(name for name in INPUTS if getattr(sample, name))
        await self._show_beside("inputs", active, alarm, at_s)
        if self.info.limit_stop is None:
            return
        ends = [sample.forward_limit, sample.reverse_limit]
        if self.info.direction == "reverse":
            ends.reverse()
        self._switches = 0
        for field, level, bit in zip(("HLS", "LLS"), ends, (MSTA_HIGH_SWITCH, MSTA_LOW_SWITCH), strict=True):
            on = level is (self.info.limit_stop == "high")
            self._switches |= bit * on
            await self[field].show(int(on), UNDEFINED if level is None else alarm, at_s)

    async def silent(self) -> None:
        """Show that nothing is known of the axis: the daemon does not publish."""
        self._moving, self._alarm = Moving.UNKNOWN, SILENT
        self._condition = assess(None, silence="nothing is published any more")
        await self._show_beside("condition", ", ".join(self._condition.notes))
        await self["RBV"].show(self["RBV"].value, SILENT)
        await self.show_motion()

    async def show_motion(self) -> None:
        """Show whether the axis moves: an axis of which that is not known has not arrived."""
        stands = self._moving is Moving.NO and not self._pending
        await self["MOVN"].show(int(not stands))
        await self["DMOV"].show(int(stands))
        await self["STAT"].show(self._alarm.status.name)
        await self["SEVR"].show(SEVERITIES[self._alarm.severity])

    async def controlled(self, axis: Axis | None, holder: str) -> None:
        """Take, give back or lose control of the axis."""
        self._axis = axis
        self._is_refused = axis is None and holder != NO_HOLDER
        self._control_wanted.clear()
        self._control_changed.set()
        await self._show_beside("control", holder)

    async def wait_wanted(self) -> None:
        """Wait until a put needs control of the axis."""
        await self._control_wanted.wait()

    async def wait_idle(self, for_s: float) -> None:
        """Wait until the axis has not moved and nothing was put that needs control for some time, in seconds.

        Raises:
            LeaseExpired: control was lost.
        """
        loop = asyncio.get_running_loop()
        while (left_s := self._used_s + for_s - loop.time()) > 0:
            await asyncio.sleep(left_s)
            if self._pending or self._wanted is not None or self._moving is not Moving.NO:
                self._used_s = loop.time()

    async def _show_beside(
        self, name: str, value: Value, alarm: RecordAlarm = NO_ALARM, at_s: float | None = None
    ) -> None:
        field = self.beside(name)
        if field is not None:  # an empty one is false
            await field.show(value, alarm, at_s)

    # -- puts --------------------------------------------------------------------------------------------------------

    def _explained(self, action: Action) -> Action:
        """Show why a put was refused beside the record: Channel Access says only that it was."""

        async def explained(asked: Value) -> Put:
            try:
                put = await action(asked)
            except (LdcndError, ValueError) as error:
                await self._show_beside("message", str(error))
                raise
            await self._show_beside("message", "")
            return put

        return explained

    async def _put_val(self, asked: Value) -> Put:
        halts = self._halts
        axis, target = await self._movable(), float(asked)
        if self["SET"].value == "Set":
            await axis.set_position(target)
            return Put(target)
        return await self._go(target, halts)

    async def _put_tweak(self, asked: Value, sign: int) -> Put:
        if not asked:
            return Put(0)
        halts = self._halts
        await self._movable()
        target = float(self._val.value) if self._wanted is None else self._wanted
        put = await self._go(target + sign * float(self["TWV"].value), halts)
        return Put(0, put.end)

    async def _go(self, target: float, halts: int) -> Put:
        """Send the axis to a target; of those that are put before it can be sent only the newest is.

        Args:
            target: in axis units.
            halts: as they were when it was put.
        """
        if self._halts != halts:
            return Put()
        low, high = float(self["LLM"].value), float(self["HLM"].value)
        if (low or high) and not low <= target <= high:
            await self["LVIO"].show(1)
            nearest = min(max(target, low), high)
            raise PositionLimit(
                f"axis {self.info.axis}: {target:g} {self.info.unit} is beyond its limit of {nearest:g}",
                axis=self.info.axis,
                value=target,
                limit=nearest,
                nearest=nearest,
            )
        self._wanted = target
        if self._waiting is None:
            self._waiting = asyncio.get_running_loop().create_future()
            self._start(self._go_to_newest(self._waiting), f"target of {self.info.axis}")
        waiting = self._waiting
        await self._val.show(target)
        return await asyncio.shield(waiting)

    async def _go_to_newest(self, waiting: "asyncio.Future[Put]") -> None:
        async with self._turn:
            self._waiting, target = None, self._wanted
            try:
                put = Put()
                if target is not None:  # not halted since it was put
                    put = await self._moved(partial(self._absolute, target), self._halts, target)
            except Exception as error:  # noqa: BLE001 - of those who have put it
                if not waiting.cancelled():
                    waiting.set_exception(error)
            else:
                if not waiting.cancelled():
                    waiting.set_result(put)
            finally:
                if self._waiting is None:
                    self._wanted = None
                    await self._show_target()

    async def _put_home(self, asked: Value, sign: int) -> Put:
        if not asked:
            return Put(0)
        halts = self._halts
        axis, velocity = await self._movable(), float(self["HVEL"].value)
        if not velocity:
            raise ValueOutOfRange(
                f"axis {self.info.axis}: HVEL is 0", axis=self.info.axis, remedy="put the velocity of the search there"
            )
        put = await self._moved(lambda: axis.home(velocity=sign * velocity), halts)
        return Put(0, put.end)

    async def _put_jog(self, asked: Value, field: str, sign: int) -> Put:
        """Begin a jog, or end the one under way."""
        self._jog_puts += 1
        halts, jog_puts, clients = self._halts, self._jog_puts, self._clients()
        await self._end_jog()
        if not asked or self._halts != halts:
            return Put(0)
        axis, begun = await self._movable(), asyncio.get_running_loop().create_future()
        if (self._halts, self._jog_puts) != (halts, jog_puts):
            return Put(0)  # halted or released while control was on its way
        self._released = asyncio.Event()
        velocity = sign * float(self["JVEL"].value)
        self._jogging = self._start(self._jog(axis, velocity, field, begun, clients), f"jog of {self.info.axis}")
        await begun
        return Put(1)

    async def _jog(
        self, axis: Axis, velocity: float, field: str, begun: "asyncio.Future[None]", clients: frozenset[object]
    ) -> None:
        """Jog until it is released, halted or at a limit, or until a client is gone: it may be the one that held it."""
        released = self._released
        self._pending += 1
        await self.show_motion()
        try:
            async with axis.jogging(velocity) as jog:
                begun.set_result(None)
                while not released.is_set() and clients <= self._clients():
                    await jog.held()
        except LdcndError as error:
            if begun.done():
                await self._show_beside("message", str(error))
            else:
                begun.set_exception(error)
        finally:
            await self._rest()
            self._pending -= 1
            await self[field].show(0)
            await self.show_motion()

    async def _end_jog(self) -> None:
        self._released.set()
        if self._jogging:
            await asyncio.shield(self._jogging)

    async def _put_stop(self, asked: Value) -> Put:
        if asked:
            await self._halt()
        return Put(0)

    async def _put_spmg(self, asked: Value) -> Put:
        await self["SPMG"].show(asked)  # from here on what moves is refused
        if asked in ("Stop", "Pause"):
            await self._halt()
        return Put()

    async def _put_cnen(self, asked: Value) -> Put:
        if asked == "Enable":
            await (await self._controlled()).power(on=True)
            return Put()
        async with self._watch(self.info.axis) as axis:  # to switch off needs no control
            await axis.power(on=False)
        return Put()

    async def _put_reset(self, asked: Value) -> Put:
        if asked:
            await (await self._controlled()).reset()
        return Put(0)

    async def _put_velo(self, asked: Value) -> Put:
        highest = self.info.limits.velocity or NO_LIMIT
        if float(asked) > highest:
            raise ValueOutOfRange(
                f"axis {self.info.axis}: {asked} {self.info.unit}/s is above its limit",
                axis=self.info.axis,
                value=asked,
                limit=highest,
            )
        return await self._put_positive(asked)

    async def _put_positive(self, asked: Value) -> Put:
        if not 0 < float(asked) < NO_LIMIT:
            raise ValueOutOfRange(f"axis {self.info.axis}: {asked} is not above 0", axis=self.info.axis, value=asked)
        return Put(asked)

    @staticmethod
    async def _keep(asked: Value) -> Put:
        return Put(asked)

    async def _absolute(self, target: float) -> Motion:
        axis = await self._controlled()
        velocity = float(self["VELO"].value)
        return await axis.move_absolute(
            target,
            buffer_mode=BufferMode.ABORTING,
            velocity=velocity,
            acceleration=velocity / float(self["ACCL"].value),
        )

    async def _moved(self, starting: Callable[[], Awaitable[Motion]], halts: int, target: float | None = None) -> Put:
        """Begin a motion, unless a halt is put meanwhile; DMOV is 0 from here to its end, however short it is."""
        await self._end_jog()  # the end of a jog is a halt, which must not come later
        self._pending += 1
        await self.show_motion()
        try:
            await self._movable()
            motion = await starting() if self._halts == halts else None
        except CommandAborted:
            if self._halts == halts:
                raise
            motion = None  # a halt was put while the motion was on its way to the daemon
        except BaseException as error:
            self._pending -= 1
            await self["LVIO"].show(int(getattr(error, "code", "") == "position_limit"))
            await self.show_motion()
            if self._halts != halts and isinstance(error, RequestRefused):
                return Put()  # it was to be halted: that has overtaken it
            raise
        if motion is None:
            self._pending -= 1
            await self.show_motion()
            return Put()
        self._sent = Sent(motion.reply, target if self.info.modulo is None else None)
        # the motion goes on when the client is gone that has put it, as it does with every motor record
        end = asyncio.shield(self._start(self._until_end(motion, halts), f"motion of {self.info.axis}"))
        await self["LVIO"].show(0)
        return Put(None, end)

    async def _until_end(self, motion: Motion, halts: int) -> None:
        try:
            if self._halts != halts:  # put while the motion was on its way to the daemon
                await (await self._controlled()).halt()
            await motion.done()
        except CommandAborted as error:
            if self._pending == 1:  # not sent elsewhere: it comes to rest
                await self._rest()
                if self._halts == halts:
                    await self._show_beside("message", str(error))
                    raise
        except LdcndError as error:
            await self._show_beside("message", str(error))
            raise
        finally:
            self._pending -= 1
            await self.show_motion()

    async def _rest(self) -> None:
        """Wait until the axis stands, but not for ever: DMOV says when it does."""
        with suppress(TimeoutError):
            async with asyncio.timeout(REST_S):
                while self._moving is not Moving.NO:
                    self._changed.clear()
                    await self._changed.wait()

    async def _halt(self) -> None:
        """Halt; where this gateway has no control a stop is the only thing that is not refused, and it latches."""
        self._halts += 1
        self._wanted = None
        self._released.set()
        if self._axis is None:
            if self._is_refused or self._moving is not Moving.NO:
                async with self._watch(self.info.axis) as axis:
                    await axis.stop()
            return
        if self._moving is not Moving.NO or self._pending:
            await self._axis.halt()

    async def _controlled(self) -> Axis:
        self._used_s = asyncio.get_running_loop().time()
        if self._axis is None:
            self._control_changed.clear()
            self._control_wanted.set()
            await self._control_changed.wait()
            self._used_s = asyncio.get_running_loop().time()
        if self._axis is None:
            held = self.beside("control")
            raise LeaseRequired(
                f"axis {self.info.axis} is not controlled by this gateway: {held.value if held is not None else ''}",
                axis=self.info.axis,
            )
        return self._axis

    async def _movable(self) -> Axis:
        axis = await self._controlled()  # which may change the unit, and so SPMG
        if self["SPMG"].value not in ("Go", "Move"):
            raise WrongState(
                f"axis {self.info.axis}: SPMG is {self['SPMG'].value}", axis=self.info.axis, remedy="put Go there"
            )
        return axis


def database(prefix: str, records: Mapping[str, MotorRecord]) -> dict[str, RecordField]:
    """Return the process variables of some axes by name."""
    return {f"{prefix}{name}": field for record in records.values() for name, field in record.fields.items()}


def _or(value: float | None, otherwise: float) -> float:
    return otherwise if value is None else value
