"""An axis as a motor record: what its fields say. What puts to them do is in `motor`.

Fields and what they mean follow the documentation of the EPICS collaboration's motor record, "Motor Record and related
software"; "User" and "dial" coordinates are the same here: OFF is 0 and DIR is Pos.
"""

import math
from functools import partial

from caproto import AlarmSeverity, AlarmStatus, SubscriptionType

from ldcnd.contract.commands import Verb
from ldcnd.contract.condition import Alarm as Severity
from ldcnd.contract.condition import assess
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
from ldcnd.contract.units import Dimension, read_quantity, shown_quantity
from ldcnd.lab.borrowed_control import NO_HOLDER
from ldcnd.lab.epics.fields import (
    NO_ALARM,
    Number,
    RecordAlarm,
    RecordField,
    Short,
    Value,
    choice,
    cut,
    motor_fields,
    number,
    string,
    text,
)

Defaults = tuple[float, float]
MOTIONLESS: Defaults = (1.0, 1.0)
"""Velocity and acceleration that are shown of what has none, and while they are not known."""
NO_LIMIT = 1e30
"""Stands for a missing limit when the other one is set; both 0 stand for none, as in the motor record."""
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
PRIVATE = frozenset({"LVAL", "LDVL", "LRVL", "LRLV", "LSPG", "MMAP", "NMAP", "PP", "CDIR"})
"""Fields that the motor record's documentation calls private and no screen shows: they are not served."""
SAME = {
    **dict.fromkeys(("DVAL",), "VAL"),
    **dict.fromkeys(("DRBV", "MLST", "ALST"), "RBV"),
    **dict.fromkeys(("RMP", "REP"), "RRBV"),
    **dict.fromkeys(("RHLS",), "HLS"),
    **dict.fromkeys(("RLLS",), "LLS"),
}
"""Fields that say the same as another one, by their names."""
PLACES = (
    *("VAL", "RBV", "DIFF", "HLM", "LLM", "DHLM", "DLLM", "HOPR", "LOPR", "TWV", "RLV", "OFF", "BDST", "RDBD", "SPDB"),
    *("MDEL", "ADEL", "HIHI", "HIGH", "LOW", "LOLO"),
)
STEPS = ("MRES", "ERES", "RRES", "UREV")
VELOCITIES = ("VELO", "BVEL", "JVEL", "HVEL", "VMAX", "VBAS")
MEASURED = {Dimension.POSITION: PLACES, Dimension.VELOCITY: VELOCITIES, Dimension.ACCELERATION: ("JAR",)}
SPEEDS = (("VELO", "BVEL", "S", "SBAK"), ("ACCL", "BACC"), ("JVEL",), ("JAR",), ("HVEL",), ("TWV",))
"""Fields that follow the defaults of the axis until a client puts another value to the first of them."""
DEADBANDS = {"MDEL": SubscriptionType.DBE_VALUE, "ADEL": SubscriptionType.DBE_LOG}
"""Fields by which those who monitor RBV are sent less, and the event for which they do."""
TO_BE_LIMITED = frozenset({"VELO", "JVEL", "HVEL"})
DURATIONS = ("ACCL", "BACC", "DLY")
MSTA_PLUS, MSTA_DONE, MSTA_HIGH_SWITCH, MSTA_POSITION = 0x1, 0x2, 0x4, 0x20
MSTA_HOME, MSTA_ENCODER, MSTA_PROBLEM, MSTA_MOVING = 0x80, 0x100, 0x200, 0x400
MSTA_GAIN_SUPPORT, MSTA_COMM, MSTA_LOW_SWITCH, MSTA_HOMED = 0x800, 0x1000, 0x2000, 0x4000
"""Bits of MSTA, in the words of its documentation: last direction, motion complete, plus limit switch, closed-loop
position control enabled; at the encoder's home signal, encoder present, hardware problem, moving; closed-loop position
control supported, communication error, minus limit switch, homed."""
MIP_MOVE = 0x20


class MotorRecord:
    """One axis; its variables are in `fields`, by their names behind the prefix.

    Attributes:
        info: what the axis is.
        defaults: its velocity and acceleration, in units a second and a second squared, when a client names no others;
            None while they are not known.
        condition: how it is.
        state: as it was published last; None when that was of a daemon that described it differently.
    """

    def __init__(self, info: AxisInfo, defaults: Defaults | None) -> None:
        self.info = info
        self.condition = assess(None)
        self.state: StateSample | None = None
        self.defaults = defaults
        self._alarm = SILENT
        self._faults: FaultSample | None = None
        self._measured = 0  # the instant of the last position, UTC in ns since 1970
        self._switches = 0  # bits of MSTA
        record = {name: field for name, field in motor_fields().items() if name not in PRIVATE}
        record["VAL"] = number()
        record |= {name: record[same] for name, same in SAME.items()}
        record["DTYP"] = choice(kind := cut(f"{info.family} {info.model}", 25), kind)
        record["SEVR"] = choice("INVALID", *SEVERITIES)
        self.fields: dict[str, RecordField] = {f"{info.axis}.{name}": field for name, field in record.items()}
        self.fields |= self._variables_beside(record["VAL"])
        for dimension, names in MEASURED.items():
            for name in names:
                self[name].convert = partial(self._typed, dimension)
        for name, value in {**self._described(), **self._speeds(), "UDF": 1}.items():
            self[name].begin(value)
        fields = (*record.values(), self.fields[f"{info.axis}:condition"])  # which says of what the alarm is
        self._of_record = tuple({id(field): field for field in fields}.values())
        for field in self._of_record:
            field.begin_in_alarm(SILENT)
        self._set_metadata()

    def _variables_beside(self, target: RecordField) -> dict[str, RecordField]:
        info, reset = self.info, Short(value=0)
        beside: dict[str, RecordField] = {
            "": target,
            "_able": choice("Enable", "Enable", "Disable"),  # as `asyn_motor.db` has it
            "-MsgTxt": text(),  # these three as NICOS and the devices of ESS have them
            "-Err": Short(value=0),
            "-ErrRst": reset,
            ":condition": text(),
            ":reset": reset,
            ":state": string(),
            ":velocity": number(),
            ":faults": text(),
            ":first_fault": string(),
            ":message": text(),
            ":control": string(NO_HOLDER),
        }
        if info.adc_full_scale:
            beside[":adc"] = number(0.0, "V")
        beside |= {f":{monitor}": number(0.0, precision=0) for monitor in info.monitors}
        if "input_signals" in info.monitors or TelemetryItem.INPUTS in info.items:
            beside[":inputs"] = text()
        return {f"{info.axis}{name}": field for name, field in beside.items()}

    def _typed(self, dimension: Dimension, text: str) -> float:
        return read_quantity(text, self.info, dimension)

    def __getitem__(self, field: str) -> RecordField:
        return self.fields[f"{self.info.axis}.{field}"]

    def beside(self, name: str) -> RecordField | None:
        """Return a variable beside the record, such as `:adc`."""
        return self.fields.get(f"{self.info.axis}{name}")

    # -- what the axis is --------------------------------------------------------------------------------------------

    @property
    def _step(self) -> float:
        """The smallest step of the axis, in its unit."""
        return 1.0 / self.info.counts_per_unit if self.info.counts_per_unit else 1.0

    @property
    def _limits(self) -> tuple[float, float]:
        low, high = self.info.limits.position_min, self.info.limits.position_max
        if low is None and high is None:
            return 0.0, 0.0
        return -NO_LIMIT if low is None else low, NO_LIMIT if high is None else high

    def _described(self) -> dict[str, Value]:
        """Return the values of fields that say what the axis is."""
        info, step = self.info, self._step
        low, high = self._limits
        return {
            **dict.fromkeys(("HLM", "DHLM", "HOPR"), high),
            **dict.fromkeys(("LLM", "DLLM", "LOPR"), low),
            **dict.fromkeys(STEPS, step),
            "SREV": 1,
            "PREC": max(0, min(9, len(f"{step:.9f}".rstrip("0").partition(".")[2]))),
            "EGU": info.unit,
            "VMAX": info.limits.velocity or 0.0,
            "SMAX": (info.limits.velocity or 0.0) / step,
            "BDST": info.approach or 0.0,
            "OUT": f"{info.bus} {info.address}",
            "DESC": f"{info.axis}, {info.model}",
            "CARD": -1,  # of what is on no VME bus
            "FRAC": 1.0,
            "UEIP": "Yes",
            "FOFF": "Frozen",
            "RTYP": "motor",
            **dict.fromkeys(("HHSV", "HSV", "LSV", "LLSV"), "NO_ALARM"),  # not used, says the documentation
        }

    def _speeds(self) -> dict[str, Value]:
        """Return the values of fields that say how an axis moves for which a client has put nothing else."""
        velocity, acceleration = self.defaults or MOTIONLESS
        return {
            **dict.fromkeys(("VELO", "BVEL", "JVEL"), velocity),
            **dict.fromkeys(("S", "SBAK"), velocity / self._step),
            **dict.fromkeys(("ACCL", "BACC"), velocity / acceleration),
            "JAR": acceleration,
            "HVEL": abs(self.info.home_velocity or 0.0),
            "TWV": 1.0,
        }

    def _set_metadata(self) -> list[RecordField]:
        """Say what numbers mean, and return those that meant something else before."""
        unit, places = self.info.unit, int(self._described()["PREC"])
        means = {
            **dict.fromkeys(PLACES, (unit, places)),
            **dict.fromkeys(STEPS, (unit, 9)),
            **dict.fromkeys(VELOCITIES, (f"{unit}/s", places)),
            **dict.fromkeys(DURATIONS, ("s", 3)),
            "JAR": (f"{unit}/s2", places),
        }
        fields = {self[name]: (*meaning, (0.0, 0.0)) for name, meaning in means.items()}
        fields |= dict.fromkeys((self["VAL"], self["RBV"]), (unit, places, self._limits))
        velocity = self.beside(":velocity")
        if velocity is not None:
            fields[velocity] = shown_quantity(0.0, self.info, Dimension.VELOCITY)[1], places, (0.0, 0.0)
        return [field for field, meaning in fields.items() if isinstance(field, Number) and field.mean(*meaning)]

    async def describe(self, info: AxisInfo, defaults: Defaults | None) -> None:
        """Take what the axis is from now on: its daemon was reloaded or restarted.

        What a client has put into a field stays, unless it cannot be: after a change of unit, or above a limit. What is
        not known in another unit yet is INVALID; of the rest every number is shown in it before its clients are told
        that it has another meaning.
        """
        before, speeds_before = self.info, self._speeds()
        is_other_unit = info.unit != before.unit
        if is_other_unit:
            await self._forget()
        self.info, self.defaults = info, defaults
        changed = self._set_metadata()
        speeds, most = self._speeds(), info.limits.velocity or NO_LIMIT
        for first, *others in SPEEDS:
            held = self[first].value
            was_put = held != speeds_before[first] and not (first in TO_BE_LIMITED and float(held) > most)
            if was_put and not is_other_unit:
                for name in (first, *others):
                    del speeds[name]
        for name, value in self._described().items():
            await self[name].show(value)
        for name, value in speeds.items():
            await self[name].show(value, SILENT if defaults is None else NO_ALARM)
        for field in changed:
            await field.write_metadata()

    async def _forget(self) -> None:
        """Show that nothing is known of the axis in its unit of now."""
        self.state = None
        await self["UDF"].show(1)
        for name, event in DEADBANDS.items():
            await self[name].show(0.0)
            self._thin(event, 0.0)
        await self.grow_old()
        for field in (self["VAL"], self["DIFF"]):
            await field.show(field.value, SILENT)

    def _thin(self, event: SubscriptionType, deadband: float) -> None:
        position = self["RBV"]
        if isinstance(position, Number):
            position.deadbands[event] = deadband

    # -- what the axis says ------------------------------------------------------------------------------------------

    async def take(self, sample: Sample, item: str = "") -> None:
        """Show a sample; the item names monitors."""
        if not self.info.describes(sample):
            await self.grow_old()  # what is shown is of the former daemon, and this one is not described here yet
            return
        alarm, at_s = QUALITIES[sample.quality], sample.t * 1e-9
        match sample:
            case PositionSample():
                await self._define()
                await self["RBV"].show(sample.value, alarm, at_s)
                await self["RRBV"].show(sample.counts, alarm, at_s)
                self._measured = sample.t
                await self.show_target()
            case VelocitySample():
                shown, _ = shown_quantity(sample.value, self.info, Dimension.VELOCITY)
                await self.show_beside(":velocity", shown, alarm, at_s)
                await self["RVEL"].show(round(sample.value / self._step))
                if sample.value and self.moving is not Moving.NO:  # a loop at rest goes to and fro
                    await self["TDIR"].show(int(sample.value > 0))
            case AdcSample():
                await self.show_beside(":adc", sample.volts, alarm, at_s)
            case InputsSample():
                await self._take_inputs(sample, alarm, at_s)
            case FaultSample():
                self._faults = sample
                await self.show_beside(":faults", "\n".join(f"{each.code}: {each.text}" for each in sample.active))
                await self.show_beside(":first_fault", sample.first.code if sample.first else "")
            case StateSample():
                await self._take_state(sample)
            case MonitorSample():
                await self.show_beside(f":{item}", sample.value, alarm, at_s)
                if item == "input_signals":
                    await self.show_beside(
                        ":inputs", ", ".join(sample.active if sample.active is not None else sample.high)
                    )

    async def _define(self) -> None:
        """Take note that a position is known."""
        if self["UDF"].value:
            await self["UDF"].show(0)
            await self.show_alarm()
            await self.show_motion()

    def target(self, state: StateSample) -> float:
        """Return where the axis was sent, or else where it is."""
        return float(self["RBV"].value) if state.target is None else state.target

    async def show_target(self) -> None:
        """Show where the axis was sent, by any program, or else where it is, and how far it is from there."""
        if self.state is None or self["UDF"].value or self.state.moving is Moving.UNKNOWN:
            return  # out of sight it goes on to where it was sent
        await self["VAL"].show(self.target(self.state))
        difference = float(self["VAL"].value) - float(self["RBV"].value)
        steps = round(difference / self._step)
        await self["DIFF"].show(difference)
        await self["RDIF"].show(steps)
        await self["RVAL"].show(int(self["RRBV"].value) + steps * (-1 if self.info.direction == "reverse" else 1))

    async def _take_state(self, sample: StateSample) -> None:
        self.state = sample
        self.condition = assess(sample, self._faults)
        await self.show_alarm()
        await self._show_condition()
        await self.show_beside("-Err", int(sample.stop_latched or sample.state is AxisState.ERROR_STOP))
        await self.show_beside(":state", sample.state.value + (", stop latched" if sample.stop_latched else ""))
        await self["CNEN"].show("Enable" if sample.enabled else "Disable")
        await self.show_target()
        await self.show_motion()

    def alarm(self) -> RecordAlarm:
        """Return the alarm of the record."""
        return SILENT if self.moving is Moving.UNKNOWN or self["UDF"].value else ALARMS[self.condition.alarm]

    async def show_alarm(self) -> None:
        """Show the alarm of the record on each of its fields."""
        await self._take_alarm(self.alarm())

    async def _take_alarm(self, alarm: RecordAlarm) -> None:
        if alarm != self._alarm:
            self._alarm = alarm
            for field in self._of_record:
                await field.take_alarm(alarm)

    async def _take_inputs(self, sample: InputsSample, alarm: RecordAlarm, at_s: float) -> None:
        """Show inputs, and the switches at both ends of the axis; a drive may not show them for a while."""
        active = ", ".join(name for name in INPUTS if getattr(sample, name))
        await self.show_beside(":inputs", active, alarm, at_s)
        await self["ATHM"].show(int(bool(sample.index)), UNDEFINED if sample.index is None else alarm, at_s)
        self._switches = MSTA_HOME * bool(sample.index)
        if self.info.limit_stop is None:
            return
        ends = [sample.forward_limit, sample.reverse_limit]
        if self.info.direction == "reverse":
            ends.reverse()
        for field, level, bit in zip(("HLS", "LLS"), ends, (MSTA_HIGH_SWITCH, MSTA_LOW_SWITCH), strict=True):
            on = level is (self.info.limit_stop == "high")
            self._switches |= bit * on
            await self[field].show(int(on), UNDEFINED if level is None else alarm, at_s)

    async def grow_old(self) -> None:
        """Show that nothing newer is known of the axis: its drive, its line or its daemon is silent."""
        self.state = self.state and self.state.model_copy(update={"moving": Moving.UNKNOWN, "motion_hidden_by": ""})
        await self._take_alarm(SILENT)
        self.condition = assess(self.state, self._faults, age_s=math.inf)
        words = (":state", ":inputs", ":faults", ":first_fault")
        for name in (*words, ":velocity", ":adc", *(f":{monitor}" for monitor in self.info.monitors)):
            field = self.beside(name)
            if field is not None:
                await field.show(field.value, SILENT)
        await self._show_condition()
        await self.show_motion()

    async def _show_condition(self) -> None:
        """Show all that is to be said of the axis."""
        await self.show_beside(":condition", ", ".join(self.condition.notes))

    async def _show_message(self) -> None:
        """Show what is wrong with the axis, not who controls it; while it moves, only what is an error.

        NICOS takes an axis with a message, and no more than a MINOR alarm, for one that has arrived.
        """
        silent = not self.stands() and self.condition.alarm < Severity.MAJOR
        troubles = () if silent else self.condition.troubles
        await self.show_beside("-MsgTxt", ", ".join(trouble.short for trouble in troubles))

    @property
    def moving(self) -> Moving:
        """Whether the axis moves; unknown as long as nothing is heard of it."""
        return self.state.moving if self.state else Moving.UNKNOWN

    def stands(self) -> bool:
        """Tell whether what was put is over: of one that is out of sight that is not known."""
        return self.state is not None and self.state.has_ended

    async def show_motion(self) -> None:
        """Show whether the axis moves."""
        stands, state = self.stands(), self.state
        await self._show_message()
        await self["MOVN"].show(int(not stands))
        await self["MIP"].show(0 if stands else MIP_MOVE)
        await self["MSTA"].show(
            (MSTA_DONE if self.state and self.state.has_ended else MSTA_MOVING)
            | MSTA_PLUS * bool(self["TDIR"].value)
            | MSTA_ENCODER
            | MSTA_GAIN_SUPPORT * (Verb.POWER in self.info.capabilities)
            | self._switches
            | MSTA_POSITION * bool(state and state.enabled)
            | MSTA_HOMED * bool(state and state.referenced)
            | MSTA_PROBLEM * bool(state and state.state is AxisState.ERROR_STOP)
            | MSTA_COMM * (state is None or state.link is LinkState.DOWN or self._alarm == SILENT)
        )
        await self["DMOV"].show(int(stands))
        await self["STAT"].show(self._alarm.status.name)
        await self["SEVR"].show(SEVERITIES[self._alarm.severity])

    async def show_beside(
        self, name: str, value: Value, alarm: RecordAlarm = NO_ALARM, at_s: float | None = None
    ) -> None:
        """Show a value of a variable beside the record, if it has it."""
        field = self.beside(name)
        if field is not None:  # an empty one is false
            await field.show(value, alarm, at_s)
