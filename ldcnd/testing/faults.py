"""What goes wrong on a simulated rig, by name: at once, after a time, where an axis comes by, or when something is so.

Every fault returns a `RigFault`, which `end` takes back; as a context manager it ends with its block. Names say what
happens to the machine, not what the drive or the daemon makes of it: that is what a program is tested against.
"""

import asyncio
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal, Self, TypedDict, Unpack

from ldcnd.contract.errors import NotSupported, ValueOutOfRange
from ldcnd.drives.ldcn.packet import CommandCode, Packet, encode_packet
from ldcnd.drives.ldcn.registers import SERVO_CYCLE_S
from ldcnd.sim.chain import Chain
from ldcnd.sim.faults import FaultKind, LineFault
from ldcnd.sim.ldcn.drive import SimulatedDrive
from ldcnd.sim.ldcn.module import EVERYBODY, SimulatedModule
from ldcnd.sim.ldcn.power import OF_POWER, FaultCondition, LogosolPower
from ldcnd.sim.plant import MotorPlant
from ldcnd.testing.truth import Machine, Terminals, Truth, terminals_of

Switch = Literal["forward", "reverse"]
Change = Callable[[float], None]
"""Something that is done to the rig at an instant of its clock, in seconds."""
OVERLOAD = 0x71
"""The alarm of a SmartStep that is too hot for its load."""


class FaultSpan(TypedDict, total=False):
    """When a fault begins, and how long it lasts: at once, and until it is ended, where nothing is said."""

    after_s: float
    """It begins so many seconds from now."""
    for_s: float
    """It lasts so many seconds."""


class FaultStart(FaultSpan, total=False):
    """When the fault of an axis begins; one of the three."""

    at: float
    """Where the axis comes by, in axis units as they are published."""
    when: Callable[[Truth], bool]
    """As soon as this is true of the axis; asked in every servo cycle."""


class RigFault:
    """One thing that goes wrong.

    Attributes:
        name: what, and where.
        begun: it has begun; it may have ended since.
        over: it has ended, or never will begin.
    """

    def __init__(self, name: str, begin: Change, end: Change, now_s: Callable[[], float]) -> None:
        self.name = name
        self.begun = False
        self.over = False
        self._begin, self._end, self._now_s = begin, end, now_s

    def begin(self) -> None:
        """Let it happen, unless it was ended before."""
        if not self.begun and not self.over:
            self.begun = True
            self._begin(self._now_s())

    def end(self) -> None:
        """Let it be right again; one that has not begun never does. What has tripped stays tripped."""
        if not self.over:
            self.over = True
            if self.begun:
                self._end(self._now_s())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.end()

    def __repr__(self) -> str:
        """Say how far it is."""
        return f"<{self.name}: {'over' if self.over else 'going on' if self.begun else 'to come'}>"


@dataclass(frozen=True, slots=True)
class Processes:
    """What can happen to the programs of a rig; each is done and undone at once.

    Attributes:
        kill_daemon: as SIGKILL does, and start it again.
        lose_client: let everything be lost that the rig's own client sends and receives, and let it be there again.
    """

    kill_daemon: tuple[Change, Change]
    lose_client: tuple[Change, Change]


class RigFaults:
    """Lets things go wrong; made by the rig.

    Every method takes when it begins and how long it lasts, see `FaultSpan`; what concerns an axis may also begin where
    the axis comes by, or when something is true of it, see `FaultStart`.

    Raises:
        UnknownAxis: there is no such axis.
        ValueOutOfRange: there is no such input, part, module or line.
        NotSupported: it cannot happen to such a drive.
    """

    def __init__(
        self,
        machine_of: Callable[[str], Machine],
        modules: Mapping[str, Terminals],
        lines: Mapping[str, Chain],
        look: Callable[[str], Truth],
        loop: asyncio.AbstractEventLoop,
        processes: Processes,
        note: Callable[[str], None],
    ) -> None:
        self._machine_of, self._modules, self._lines, self._look = machine_of, modules, lines, look
        self._loop, self._processes, self._note = loop, processes, note
        self._made_so_far: list[RigFault] = []

    @property
    def to_come(self) -> tuple[RigFault, ...]:
        """What has neither begun nor been taken back."""
        return tuple(fault for fault in self._made_so_far if not fault.begun and not fault.over)

    # -- the machine -------------------------------------------------------------------------------------------------

    def jam(
        self,
        axis: str,
        **start: Unpack[FaultStart],
    ) -> RigFault:
        """Let something hold the shaft."""
        machine = self._machine_of(axis)
        if not isinstance(machine.module, SimulatedDrive):
            unit = machine.unit
            return self._on(
                axis,
                "jam",
                lambda at_s: unit.drive.set_jammed(at_s, jammed=True),
                lambda at_s: unit.drive.set_jammed(at_s, jammed=False),
                start,
            )
        return self._condition(axis, "jam", FaultCondition.STALLED, start)

    def slip(
        self,
        axis: str,
        by: float,
        **start: Unpack[FaultStart],
    ) -> RigFault:
        """Let the coupling slip: the load, with its limit switches, stays behind the encoder by `by` axis units."""
        machine = self._machine_of(axis)
        servo, counts = machine.servo, by * machine.config.signed_counts_per_unit

        def move(way: float) -> Change:
            def begin(at_s: float) -> None:
                servo.catch_up(at_s)
                machine.slipped_counts += way
                plant = servo.shaft.plant
                servo.shaft.become(
                    plant.model_copy(
                        update={
                            "reverse_limit_counts": round(plant.reverse_limit_counts + way),
                            "forward_limit_counts": round(plant.forward_limit_counts + way),
                        }
                    )
                )

            return begin

        return self._on(axis, f"slip by {by:g}", move(counts), move(-counts), start)

    def friction(
        self,
        axis: str,
        times: float,
        **start: Unpack[FaultStart],
    ) -> RigFault:
        """Multiply the friction of the machine."""
        return self._machine(
            axis,
            f"friction times {times:g}",
            lambda plant: plant.model_copy(
                update={"friction_nm": plant.friction_nm * times, "viscous_nm_s": plant.viscous_nm_s * times}
            ),
            start,
        )

    def load(
        self,
        axis: str,
        torque_nm: float,
        **start: Unpack[FaultStart],
    ) -> RigFault:
        """Let a load pull at the shaft, forward when positive."""
        return self._machine(
            axis,
            f"load of {torque_nm:g} Nm",
            lambda plant: plant.model_copy(update={"load_nm": torque_nm}),
            start,
        )

    def phase_lost(
        self,
        axis: str,
        **start: Unpack[FaultStart],
    ) -> RigFault:
        """Open one phase of a brushless motor: no torque in two thirds of a turn, and no drive notices."""
        return self._machine(axis, "phase lost", lambda plant: plant.model_copy(update={"phase_lost": True}), start)

    # -- switches and sensors ----------------------------------------------------------------------------------------

    def limit_closed(
        self,
        axis: str,
        switch: Switch,
        **start: Unpack[FaultStart],
    ) -> RigFault:
        """Actuate a limit switch of the drive, wherever the axis is."""
        return self._switch(axis, f"{switch} limit closed", f"{switch}_stuck", start, closed=True)

    def limit_stuck(
        self,
        axis: str,
        switch: Switch,
        **start: Unpack[FaultStart],
    ) -> RigFault:
        """Let a limit switch stay open, also where the axis actuates it."""
        return self._switch(axis, f"{switch} limit stuck", f"{switch}_stuck", start, closed=False)

    def index_lost(
        self,
        axis: str,
        **start: Unpack[FaultStart],
    ) -> RigFault:
        """Let no index pulse come any more."""
        return self._switch(axis, "index lost", "index_stuck", start, closed=False)

    def encoder_lost(
        self,
        axis: str,
        **start: Unpack[FaultStart],
    ) -> RigFault:
        """Let a differential encoder or a Hall sensor lose its signal; a Logosol drive notices."""
        return self._condition(axis, "encoder lost", FaultCondition.ENCODER_LOSS, start)

    def encoder_stuck(
        self,
        axis: str,
        **start: Unpack[FaultStart],
    ) -> RigFault:
        """Let the counter stand still while the shaft turns; no drive notices by itself."""
        return self._condition(axis, "encoder stuck", FaultCondition.ENCODER_STUCK, start)

    # -- the drive ---------------------------------------------------------------------------------------------------

    def overheat(
        self,
        axis: str,
        **start: Unpack[FaultStart],
    ) -> RigFault:
        """Let the drive become too hot; a SmartStep has its overload alarm."""
        machine = self._machine_of(axis)
        if not isinstance(machine.module, SimulatedDrive):
            unit = machine.unit
            return self._on(
                axis,
                "overload",
                lambda at_s: unit.drive.provoke(OVERLOAD, at_s),
                lambda _: None,
                start,
            )
        return self._condition(axis, "overheat", FaultCondition.OVERHEAT, start)

    def overcurrent(
        self,
        axis: str,
        **start: Unpack[FaultStart],
    ) -> RigFault:
        """Let the drive's overcurrent protection trip."""
        return self._condition(axis, "overcurrent", FaultCondition.OVERCURRENT, start)

    def motor_short(
        self,
        axis: str,
        **start: Unpack[FaultStart],
    ) -> RigFault:
        """Short-circuit the motor."""
        return self._condition(axis, "motor short", FaultCondition.MOTOR_SHORT, start)

    def overvoltage(
        self,
        axis: str,
        **start: Unpack[FaultStart],
    ) -> RigFault:
        """Let the supply of the drive rise too high."""
        return self._condition(axis, "overvoltage", FaultCondition.OVERVOLTAGE, start)

    def motor_supply_lost(
        self,
        axis: str,
        **start: Unpack[FaultStart],
    ) -> RigFault:
        """Take away the motor's supply; a PIC-SERVO goes on answering.

        A Logosol drive has one supply for its motor and itself: it is off as after `power_loss` (LS-182AP manual,
        "Undervoltage/Overvoltage Protection").
        """
        if isinstance(self._machine_of(axis).servo.stage, LogosolPower):
            return self.power_loss(axis, **start)
        return self._condition(axis, "motor supply lost", FaultCondition.MOTOR_POWER_OFF, start)

    def stop_input(
        self,
        axis: str,
        **start: Unpack[FaultStart],
    ) -> RigFault:
        """Open the stop input of a Logosol drive."""
        return self._condition(axis, "stop input", FaultCondition.STOP_INPUT, start)

    def power_loss(
        self,
        axis: str,
        **start: Unpack[FaultStart],
    ) -> RigFault:
        """Switch the drive's supply off, and on again at the end: it has forgotten everything then."""
        machine = self._machine_of(axis)
        module = machine.module
        if isinstance(module, SimulatedModule):
            off, on = (lambda at_s: module.power(on=False, at_s=at_s)), (lambda at_s: module.power(on=True, at_s=at_s))
        else:
            off, on = machine.unit.power_off, machine.unit.power_on
        return self._on(axis, "power loss", off, on, start)

    def mute(
        self,
        axis: str,
        **start: Unpack[FaultStart],
    ) -> RigFault:
        """Let the drive's transmitter fail: it hears and obeys, and nobody hears it. On a SmartStep line all drives."""
        machine = self._machine_of(axis)
        chain, place = machine.chain, min(machine.place, len(machine.chain.modules))
        return self._on(
            axis,
            "mute",
            lambda _: chain.mute(place, on=True),
            lambda _: chain.mute(place, on=False),
            start,
        )

    # -- I/O modules and what stands around them ---------------------------------------------------------------------

    def input_stuck(self, name: str, *, high: bool, **start: Unpack[FaultSpan]) -> RigFault:
        """Hold the line of a named input at a level, whatever its sensor sees: a wire that is cut leaves it high.

        One that is shorted to ground makes it low. At the end the sensor is connected again.
        """
        inputs = {
            of: (each.io, wired.line) for each in self._modules.values() for of, wired in each.config.inputs.items()
        }
        if name not in inputs:
            raise ValueOutOfRange(f"there is no input {name!r}; there are: {', '.join(inputs) or 'none'}", value=name)
        io, line = inputs[name]
        return self._of_rig(
            f"{name}: stuck {'high' if high else 'low'}",
            lambda at_s: io.drive_line(line, high=high, at_s=at_s),
            lambda at_s: io.plug_in(line, at_s),
            start,
        )

    def part_stuck(self, part: str, **start: Unpack[FaultSpan]) -> RigFault:
        """Let a door, a bolt or another part of the machine, see `[[sim.part]]`, stay where it is."""
        parts = {name: each.io for each in self._modules.values() for name in each.io.around.names}
        if part not in parts:
            raise ValueOutOfRange(f"there is no part {part!r}; there are: {', '.join(parts) or 'none'}", value=part)
        io = parts[part]
        return self._of_rig(
            f"{part}: stuck",
            lambda at_s: io.jam(part, jammed=True, at_s=at_s),
            lambda at_s: io.jam(part, jammed=False, at_s=at_s),
            start,
        )

    def module_power_loss(self, module: str, **start: Unpack[FaultSpan]) -> RigFault:
        """Switch an I/O module's supply off, and on again at the end: all its lines are inputs then."""
        io = terminals_of(self._modules, module).io
        return self._of_rig(
            f"{module}: power loss",
            lambda at_s: io.power(on=False, at_s=at_s),
            lambda at_s: io.power(on=True, at_s=at_s),
            start,
        )

    # -- the line ----------------------------------------------------------------------------------------------------

    def cable_cut(
        self, axis: str, **start: Unpack[FaultStart]
    ) -> RigFault:  # fmt: skip
        """Cut the cable before a drive: it and all behind it are off the line, and go on with what they do."""
        machine = self._machine_of(axis)
        chain, place = machine.chain, machine.place - 1
        return self._on(axis, "cable cut", lambda _: chain.cut_behind(place), lambda _: chain.join(), start)

    def noise(self, probability: float, line: str | None = None, **start: Unpack[FaultSpan]) -> RigFault:
        """Flip a bit of a request or of a reply, each with this probability.

        Args:
            probability: 0 to 1.
            line: which; the only one of the rig when missing.
            after_s: when it begins.
            for_s: how long it lasts.
        """
        _check_share("noise", probability)
        wrong = tuple(
            LineFault(kind, probability) for kind in (FaultKind.REQUEST_BIT_FLIPPED, FaultKind.REPLY_BIT_FLIPPED)
        )
        return self._wires(f"noise of {probability:g}", line, wrong, start)

    def late_replies(self, longest_s: float, line: str | None = None, **start: Unpack[FaultSpan]) -> RigFault:
        """Delay every reply by up to so many seconds, as a sluggish adapter does."""
        wrong = (LineFault(FaultKind.REPLY_DELAYED, longest_s=longest_s),)
        return self._wires(f"replies late by up to {longest_s:g} s", line, wrong, start)

    def lost_replies(self, probability: float, line: str | None = None, **start: Unpack[FaultSpan]) -> RigFault:
        """Lose whole replies, each with this probability."""
        _check_share("lost replies", probability)
        wrong = (LineFault(FaultKind.REPLY_LOST, probability),)
        return self._wires(f"replies lost, {probability:g}", line, wrong, start)

    def unplug(
        self, line: str | None = None, **start: Unpack[FaultSpan]
    ) -> RigFault:  # fmt: skip
        """Pull the adapter out of the machine."""
        name, chain = self._line(line)
        return self._of_rig(f"{name}: unplugged", chain.unplug, lambda _: chain.replug(), start)

    def reset_by_another(self, line: str | None = None, **start: Unpack[FaultSpan]) -> RigFault:
        """Let another program on the line reset all drives, as a vendor's utility does at its start."""
        name, chain = self._line(line)
        packet = encode_packet(Packet(EVERYBODY, CommandCode.HARD_RESET))

        def reset(at_s: float) -> None:
            for module in chain.modules:
                module.catch_up(at_s)
                for value in packet:
                    module.hear(value, at_s)

        return self._of_rig(f"{name}: reset by another program", reset, lambda _: None, start)

    # -- programs ----------------------------------------------------------------------------------------------------

    def daemon_killed(self, **start: Unpack[FaultSpan]) -> RigFault:
        """Kill the daemon, as SIGKILL does, and start it again at the end."""
        return self._of_rig("daemon killed", *self._processes.kill_daemon, start)

    def client_lost(self, **start: Unpack[FaultSpan]) -> RigFault:
        """Cut the rig's own client off from the network: it can neither renew its control nor hear anything."""
        return self._of_rig("client lost", *self._processes.lose_client, start)

    # -- how they happen ---------------------------------------------------------------------------------------------

    def _condition(
        self, axis: str, name: str, condition: FaultCondition, start: FaultStart
    ) -> RigFault:  # fmt: skip
        machine = self._machine_of(axis)
        servo = machine.servo
        if condition in OF_POWER - servo.stage.feels:
            raise NotSupported(f"axis {axis}: {name} has no effect on a {machine.config.model}", axis=axis)
        return self._on(
            axis,
            name,
            lambda at_s: servo.set_condition(condition, present=True, at_s=at_s),
            lambda at_s: servo.set_condition(condition, present=False, at_s=at_s),
            start,
        )

    def _machine(self, axis: str, name: str, change: Callable[[MotorPlant], MotorPlant], start: FaultStart) -> RigFault:
        servo = self._machine_of(axis).servo
        before = servo.shaft.plant

        def begin(at_s: float) -> None:
            nonlocal before
            servo.catch_up(at_s)
            before = servo.shaft.plant
            servo.shaft.become(change(before))

        def end(at_s: float) -> None:
            servo.catch_up(at_s)
            servo.shaft.become(before)

        return self._on(axis, name, begin, end, start)

    def _switch(self, axis: str, name: str, what: str, start: FaultStart, *, closed: bool) -> RigFault:  # fmt: skip
        servo = self._machine_of(axis).servo
        if not hasattr(servo.shaft, what):
            raise ValueOutOfRange(f"{name}: a limit switch is forward or reverse", value=name)

        def put(value: bool | None) -> Change:  # noqa: FBT001 - the level, or that it works
            def change(at_s: float) -> None:
                servo.catch_up(at_s)
                setattr(servo.shaft, what, value)

            return change

        return self._on(axis, name, put(closed), put(None), start)

    def _wires(self, name: str, line: str | None, wrong: tuple[LineFault, ...], start: FaultSpan) -> RigFault:
        where, chain = self._line(line)

        def begin(_: float) -> None:
            for each in wrong:
                chain.begin(each)

        def end(_: float) -> None:
            for each in wrong:
                chain.end(each)

        return self._of_rig(f"{where}: {name}", begin, end, start)

    def _line(self, name: str | None) -> tuple[str, Chain]:
        if name is None and len(self._lines) == 1:
            return next(iter(self._lines.items()))
        if name is None or name not in self._lines:
            raise ValueOutOfRange(f"line {name!r} is not one of {', '.join(self._lines)}", value=name or "none")
        return name, self._lines[name]

    def _on(self, axis: str, name: str, begin: Change, end: Change, start: FaultStart) -> RigFault:
        _check_names(name, start, FaultStart.__optional_keys__)
        if sum(key in start for key in ("after_s", "at", "when")) > 1:
            raise ValueOutOfRange(f"{axis}: {name}: it begins after_s, at or when; give one of them", value=len(start))
        fault = self._made(f"{axis}: {name}", begin, end)
        when = start.get("when")
        if (place := start.get("at")) is not None:
            when = _passing(self._look(axis).position, place)
        if when is None:
            self._begin(fault, start)
            return fault

        def look() -> None:
            if when(self._look(axis)):
                self._begin_now(fault, start)
            elif not fault.over:
                self._loop.call_later(SERVO_CYCLE_S, look)

        look()
        return fault

    def _of_rig(self, name: str, begin: Change, end: Change, start: FaultSpan) -> RigFault:
        _check_names(name, start, FaultSpan.__optional_keys__)
        fault = self._made(name, begin, end)
        self._begin(fault, start)
        return fault

    def _made(self, name: str, begin: Change, end: Change) -> RigFault:
        def begun(at_s: float) -> None:
            self._note(f"{name} begins")
            begin(at_s)

        def ended(at_s: float) -> None:
            self._note(f"{name} ends")
            end(at_s)

        fault = RigFault(name, begun, ended, self._loop.time)
        self._made_so_far.append(fault)
        return fault

    def _begin(self, fault: RigFault, start: FaultSpan) -> None:
        if "after_s" in start:
            self._loop.call_later(start["after_s"], self._begin_now, fault, start)
        else:
            self._begin_now(fault, start)

    def _begin_now(self, fault: RigFault, start: FaultSpan) -> None:
        fault.begin()
        if "for_s" in start:
            self._loop.call_later(start["for_s"], fault.end)


def _check_names(name: str, start: Mapping[str, object], known: frozenset[str]) -> None:
    unknown = start.keys() - known
    if unknown:
        raise TypeError(f"{name}: there is no {min(unknown)!r}; there are {', '.join(sorted(known))}")


def _check_share(name: str, share: float) -> None:
    if not 0.0 <= share <= 1.0:
        raise ValueOutOfRange(f"{name}: a probability is 0 to 1, not {share:g}", value=share)


def _passing(before: float, place: float) -> Callable[[Truth], bool]:
    """Return what becomes true where an axis passes a place, from either side."""

    def passes(truth: Truth) -> bool:
        nonlocal before
        low, high = sorted((before, truth.position))
        before = truth.position
        return low <= place <= high

    return passes
