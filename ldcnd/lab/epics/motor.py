"""An axis as a motor record that moves it: what puts to its fields do.

What the gateway cannot do is read-only, such as the offset and retries.
"""

import asyncio
from collections.abc import Awaitable, Callable, Coroutine
from contextlib import AbstractAsyncContextManager
from functools import partial
from itertools import count

from ldcnd.client.axis import Axis
from ldcnd.client.motion import Jogging, Motion
from ldcnd.contract.commands import BufferMode, Verb
from ldcnd.contract.errors import (
    CommandAborted,
    LdcndError,
    PositionLimit,
    RequestRefused,
    ValueOutOfRange,
    WrongState,
)
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.samples import StateSample
from ldcnd.lab.epics.fields import Action, Put, RecordField, Value
from ldcnd.lab.epics.goals import Distance, GoalPosition, Meant
from ldcnd.lab.epics.record import DEADBANDS, Defaults
from ldcnd.lab.epics.watched import WatchedRecord

OF_MOTIONS = ("VELO", "ACCL", "HVEL", "JVEL", "JAR")
"""Fields that say how fast a motion is."""
MOTIONS = frozenset({".VAL", ".RLV", ".TWF", ".TWR", ".HOMF", ".HOMR", ".JOGF", ".JOGR"})


class MovedRecord(WatchedRecord):
    """An axis whose record can be put to.

    Args:
        info: what the axis is.
        defaults: its velocity and acceleration, in units a second and a second squared, when a client names no others.
        start: keeps a task until its end.
        clients: returns who is connected: a jog ends when one of them is gone.
    """

    def __init__(
        self,
        info: AxisInfo,
        defaults: Defaults | None,
        start: Callable[[Coroutine[object, object, None], str], asyncio.Future[None]],
        clients: Callable[[], frozenset[object]],
    ) -> None:
        super().__init__(info, defaults)
        self._start = start
        self._clients = clients
        self._jog_puts = 0
        self._halting = 0  # halts on their way to the daemon
        self._shown = 0  # puts of halts that the shown target already counts from
        self._halts = 0  # puts so far that halt: a motion that was put before one does not begin after it
        self._wanted: float | None = None  # the newest target that was put and has no reply yet
        self._waiting: asyncio.Future[Put] | None = None  # what sends it once those before it have a reply
        self._numbers = count(1)  # of what is put and moves, in its order
        self._newest: Meant | None = None  # what put the newest target
        self._replaces = 0  # the number of what in it was no distance
        # distances that wait for the end of the motion before them, on an axis with a modulo, by their numbers
        self._distances: dict[int, float] = {}
        self._onward: Meant | None = None  # what put the last of them
        self._gone = 0  # nothing with a lower number begins any more: what was put after it, and is none, has begun
        self._going_on: tuple[asyncio.Future[None], asyncio.Future[None]] | None = None  # their begin and their end
        self._begun: object = None  # the motion or the jog that was begun last
        self._last: asyncio.Future[None] | None = None  # the end of the motion that was begun last
        self._turn = asyncio.Lock()
        self._released = asyncio.Event()  # the jog under way is to end
        self._jogging: asyncio.Future[None] | None = None
        self._take_puts()

    def _take_puts(self) -> None:
        can = set(self.info.capabilities)
        always: dict[str, Action] = {".STOP": self._put_stop, ".SPMG": self._put_spmg}
        others: dict[str, Action] = {}
        if Verb.MOVE_ABSOLUTE in can:
            others |= {
                **{f".{name}": partial(self._put_deadband, event) for name, event in DEADBANDS.items()},
                ".VAL": self._put_val,
                ".RLV": lambda asked: self._put_distance(float(asked)),
                ".TWV": self._keep,
                ".TWF": lambda asked: self._put_tweak(asked, 1),
                ".TWR": lambda asked: self._put_tweak(asked, -1),
                ".VELO": lambda asked: self._put_with(self._put_velo, asked, "BVEL", ("S", "SBAK")),
                ".ACCL": lambda asked: self._put_with(self._put_positive, asked, "BACC", ()),
                ".SET": self._keep,
                ".SSET": lambda asked: self._put_set("Set", asked),
                ".SUSE": lambda asked: self._put_set("Use", asked),
            }
        if Verb.JOG in can:
            others |= {
                ".JOGF": lambda asked: self._put_jog(asked, "JOGF", 1),
                ".JOGR": lambda asked: self._put_jog(asked, "JOGR", -1),
                ".JVEL": self._put_velo,
                ".JAR": self._put_positive,
            }
        if Verb.HOME in can:
            others |= {
                ".HVEL": self._put_velo,
                ".HOMF": lambda asked: self._put_home(asked, 1),
                ".HOMR": lambda asked: self._put_home(asked, -1),
            }
        if Verb.POWER in can:
            always[".CNEN"] = self._put_cnen
        if Verb.RESET in can:
            always[":reset"] = self._put_reset
        if others:
            always |= {".DISP": self._put_disp, "_able": self._put_able}
        for name, action in {**always, **others}.items():
            field = self.beside(name)
            if field is not None:
                field.action = self._explained(action, is_always=name in always, is_motion=name in MOTIONS)
                field.explain = partial(self.show_beside, ":message")

    # -- what the axis says ------------------------------------------------------------------------------------------

    async def describe(self, info: AxisInfo, defaults: Defaults | None) -> None:
        """Take what the axis is from now on.

        After a change of unit nothing moves until Go is put to SPMG: numbers of clients may be in the former one.
        """
        before = self.info
        if info.unit != before.unit:
            await self["SPMG"].show("Stop")
        await super().describe(info, defaults)
        if info.unit != before.unit:
            await self.show_beside(
                ":message", f"its unit is {info.unit} now and was {before.unit}: put Go to SPMG to let it move"
            )

    def target(self, state: StateSample) -> float:
        """Return where the axis was sent, by any program, or is to be sent, or else where it is."""
        sent, modulo = self._wanted, self.info.modulo
        if sent is None:
            sent = self.control.set_point(state, lambda: float(self["RBV"].value))
        way = sum(by for number, by in self._distances.items() if number >= self._replaces)
        return (sent + way) % modulo if modulo and way else sent

    def stands(self) -> bool:
        """Tell whether the axis has done what was put."""
        return super().stands() and not self._pending and self._going_on is None

    def is_busy(self) -> bool:
        """Tell whether the axis moves, or is to move."""
        return self._wanted is not None or self._going_on is not None or bool(self._pending) or not super().stands()

    async def show_control(self, holder: str) -> None:
        """Show who controls the axis."""
        await self.show_beside(":control", holder)

    # -- puts --------------------------------------------------------------------------------------------------------

    async def _put_val(self, asked: Value) -> Put:
        return await self._go(GoalPosition(float(asked)))

    async def _put_tweak(self, asked: Value, sign: int) -> Put:
        return await self._put_distance(sign * float(self["TWV"].value)) if asked else Put(0)

    async def _put_distance(self, by: float) -> Put:
        put = await self._go(Distance(by))
        return Put(0, put.end)

    def _meant(self) -> Meant:
        """Return what a put of now means; asked before anything is waited for.

        Raises:
            WrongState: SPMG lets nothing move.
        """
        self._check_may_move()
        speeds = {} if self.defaults is None else {name: float(self[name].value) for name in OF_MOTIONS}
        return Meant(next(self._numbers), self._halts, self["SET"].value == "Set", speeds)

    def _speed(self, meant: Meant, name: str) -> float:
        """Return what a field of a velocity or an acceleration had when something was put, or what is known since."""
        return meant.speeds.get(name, float(self[name].value))

    async def _go(self, goal: GoalPosition | Distance) -> Put:
        """Send the axis to a goal; where SET is Set, say that it is there.

        All goals pass here. A homing and a jog have none: they move with Set as well, as in the record's own code.
        """
        meant, is_distance = self._meant(), isinstance(goal, Distance)
        axis = await self._movable()
        if is_distance and self["UDF"].value:
            raise WrongState(
                f"axis {self.info.axis}: where it is is not known", axis=self.info.axis, remedy="put a position to VAL"
            )
        if meant.sets:
            async with self._turn:  # a distance counts from what was said before it
                await axis.set_position(goal.behind(float(self["VAL"].value)))
                await self._show_from_now_on()
            return Put()
        if is_distance and (self._shown != meant.halts or (self._jogging and not self._jogging.done())):
            await self._come_to_rest(meant.number, meant.halts)
        if self._halts != meant.halts:
            return Put()
        if meant.number < self._gone:
            return self._overtaken()
        if isinstance(goal, Distance) and self.info.modulo is not None:
            return await self._go_on(goal.by, meant)
        target = goal.behind(float(self["VAL"].value) if self._wanted is None else self._wanted)
        return await self._go_to(target, meant, self._replaces if is_distance else meant.number)

    async def _come_to_rest(self, number: int, halts: int) -> None:
        """Wait until the axis stands behind a halt or a jog: from there a distance counts that was put behind it.

        Raises:
            CommandAborted: the axis was stopped meanwhile, which is no halt of this record.
            LdcndError: it does not come to rest, or is out of sight.
        """
        await self._end_jog()
        while self._halting:  # until it is answered VAL is the target of before
            await self._news()
        await self._stands_unless(lambda: number < self._gone or self._halts != halts or self._shown == halts)
        is_behind = True
        while is_behind:
            async with self._turn:  # what was put after it has begun, or was refused
                await self._show_from_now_on()
            is_behind = self._wanted is not None and self._replaces > number
        if self._halts == halts:
            self._shown = halts

    def _overtaken(self) -> Put:
        """Return the outcome of what begins no more, since what was put after it has: no refusal, but not done."""
        end: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        error = f"axis {self.info.axis}: what was put after it has begun before it"
        end.set_exception(CommandAborted(error, axis=self.info.axis))
        end.exception()  # perhaps nobody waits for it
        return Put(None, end)

    async def _go_on(self, by: float, meant: Meant) -> Put:
        """Send an axis with a modulo on by a distance, which no place within a turn can tell: as what it is.

        It is sent when the motion before it has ended as it was put: in mid-move a drive that is halted first would
        count it from there. Those that wait add up; whatever else is put that halts, or begins to move, replaces them.
        """
        is_behind, self._distances[meant.number] = bool(self._pending) or self._wanted is not None, by
        self._onward = meant
        if self._going_on is None:
            begun: asyncio.Future[None] = asyncio.get_running_loop().create_future()
            self._going_on = begun, self._start(self._send_distances(begun), f"distance of {self.info.axis}")
        begun, end = self._going_on
        await self.show_target()
        if not is_behind:
            await asyncio.wait((begun, end), return_when=asyncio.FIRST_COMPLETED)
            if end.done():
                await end  # it may have been refused
        return Put(None, asyncio.shield(end))

    async def _send_distances(self, begun: "asyncio.Future[None]") -> None:
        put: Put | None = None
        try:
            while put is None:
                before = self._last
                if before and not before.done():
                    await asyncio.shield(before)
                async with self._turn:
                    if self._last is before:
                        way, self._distances, self._going_on = sum(self._distances.values()), {}, None
                        last, put = self._onward, Put()
                        if way and last:
                            starting = partial(self._relative, way, last)
                            put = await self._moved(starting, self._halts, next(self._numbers), 0)
        except LdcndError as error:
            if self._going_on and self._going_on[0] is begun:  # what goes before has failed
                self._distances, self._going_on = {}, None
            await self.show_beside(":message", str(error))
            raise
        finally:
            await self.show_target()
            await self._show_end()
        begun.set_result(None)
        if put.end:
            await put.end

    async def _go_to(self, target: float, meant: Meant, replaces: int) -> Put:
        """Send the axis to a target, in axis units; of those that are put before it can be sent only the newest is."""
        low, high = float(self["LLM"].value), float(self["HLM"].value)
        if (low or high) and not low <= target <= high:
            await self["LVIO"].show(1)
            nearest = min(max(target, low), high)
            raise PositionLimit(
                f"axis {self.info.axis}: {target:.12g} {self.info.unit} is beyond its limit of {nearest:.12g}",
                axis=self.info.axis,
                value=target,
                limit=nearest,
                nearest=nearest,
            )
        self._wanted, self._newest, self._replaces = target, meant, replaces
        if self._waiting is None:
            self._waiting = asyncio.get_running_loop().create_future()
            self._start(self._go_to_newest(self._waiting), f"target of {self.info.axis}")
        waiting = self._waiting
        await self["VAL"].show(target)
        return await asyncio.shield(waiting)

    async def _go_to_newest(self, waiting: "asyncio.Future[Put]") -> None:
        async with self._turn:
            self._waiting, target, newest = None, self._wanted, self._newest
            try:
                put = Put()
                if target is not None and newest is not None:  # not halted since it was put
                    starting = partial(self._absolute, target, newest)
                    put = await self._moved(starting, self._halts, newest.number, self._replaces, target)
            except Exception as error:  # noqa: BLE001 - of those who have put it
                if not waiting.cancelled():
                    waiting.set_exception(error)
            else:
                if not waiting.cancelled():
                    waiting.set_result(put)
            finally:
                if self._waiting is None:
                    self._wanted, self._replaces = None, 0
                    await self.show_target()

    async def _put_home(self, asked: Value, sign: int) -> Put:
        if not asked:
            return Put(0)
        meant = self._meant()
        async with self._turn:  # no distance begins before it is known whether this replaces it
            axis, velocity = await self._movable(), self._speed(meant, "HVEL")
            if not velocity:
                raise ValueOutOfRange(
                    f"axis {self.info.axis}: HVEL is 0",
                    axis=self.info.axis,
                    remedy="put the velocity of the search there",
                )
            starting = partial(axis.home, velocity=sign * velocity)
            put = await self._moved(starting, meant.halts, meant.number, meant.number)
        field = self["HOMF" if sign > 0 else "HOMR"]
        if put.end is None:
            return Put(0)
        await field.show(1)
        return Put(None, self._start(_then(put.end, field), f"homing of {self.info.axis}"))

    async def _put_jog(self, asked: Value, field: str, sign: int) -> Put:
        """Begin a jog, or end the one under way."""
        self._jog_puts += 1
        jog_puts, clients = self._jog_puts, self._clients()
        if not asked:
            await self._end_jog()
            return Put(0)
        self._released.set()  # also where this one is refused
        meant = self._meant()
        await self._end_jog()
        if self._halts != meant.halts:
            return Put(0)
        async with self._turn:  # as for a homing
            axis, begun = await self._movable(), asyncio.get_running_loop().create_future()
            if (self._halts, self._jog_puts) != (meant.halts, jog_puts):
                return Put(0)  # halted or released while control was on its way
            self._released = asyncio.Event()
            jogging = axis.jogging(sign * self._speed(meant, "JVEL"), acceleration=self._speed(meant, "JAR"))
            self._jogging = self._start(self._jog(jogging, field, begun, clients), f"jog of {self.info.axis}")
            await begun
            self._has_begun(begun, meant.number)
        return Put(1)

    async def _jog(
        self,
        jogging: AbstractAsyncContextManager[Jogging],
        field: str,
        begun: "asyncio.Future[None]",
        clients: frozenset[object],
    ) -> None:
        """Jog until it is released, halted or at a limit, or until a client is gone: it may be the one that held it."""
        released, has_begun = self._released, False
        self._pending += 1
        await self.show_motion()
        try:
            async with jogging as jog:
                has_begun = True
                begun.set_result(None)
                while not released.is_set() and clients <= self._clients():
                    await jog.held()
        except LdcndError as error:
            if has_begun:
                await self.show_beside(":message", str(error))
            else:
                begun.set_exception(error)
        finally:
            if has_begun:  # otherwise what moves is something else, which goes on
                await self._rest()
            self._pending -= 1
            await self[field].show(0)
            await self._show_end()

    async def _end_jog(self) -> None:
        self._released.set()
        if self._jogging:
            await asyncio.shield(self._jogging)

    async def _put_stop(self, asked: Value) -> Put:
        if asked:
            await self.halt()
        return Put(0)

    async def _put_spmg(self, asked: Value) -> Put:
        await self["SPMG"].show(asked)  # from here on what moves is refused
        if asked in ("Stop", "Pause"):
            await self.halt()
        return Put()

    async def _put_cnen(self, asked: Value) -> Put:
        if asked == "Enable":
            await self.control.power_on()
        else:
            await self.control.power_off()
        return Put()

    async def _put_reset(self, asked: Value) -> Put:
        if asked:
            await self.control.reset()
        return Put(0)

    async def _absolute(self, target: float, meant: Meant) -> Motion:
        axis, (velocity, acceleration) = await self.control.taken(), self._rates(meant)
        return await axis.move_absolute(
            target, buffer_mode=BufferMode.ABORTING, velocity=velocity, acceleration=acceleration
        )

    async def _relative(self, by: float, meant: Meant) -> Motion:
        axis, (velocity, acceleration) = await self.control.taken(), self._rates(meant)
        return await axis.move_relative(
            by, buffer_mode=BufferMode.BUFFERED, velocity=velocity, acceleration=acceleration
        )

    def _rates(self, meant: Meant) -> tuple[float, float]:
        """Return the velocity and acceleration of a move, in units a second and a second squared."""
        velocity = self._speed(meant, "VELO")
        return velocity, velocity / self._speed(meant, "ACCL")

    def _has_begun(self, what: object, number: int) -> None:
        """Note what has begun, and not only been put: what was put before it, by its number, begins no more."""
        self._begun, self._gone = what, max(self._gone, number)
        self._distances = {each: by for each, by in self._distances.items() if each >= self._gone}

    async def _moved(
        self,
        starting: Callable[[], Awaitable[Motion]],
        halts: int,
        number: int,
        replaces: int,
        target: float | None = None,
    ) -> Put:
        """Begin a motion, unless a halt is put meanwhile; DMOV is 0 from here to its end, however short it is."""
        await self._end_jog()  # the end of a jog is a halt, which must not come later
        self._pending += 1
        await self.show_motion()
        try:
            await self._movable()
            motion = await starting() if self._halts == halts and number >= self._gone else None
        except BaseException as error:
            self._pending -= 1
            # a halt was put while it was on its way to the daemon, and has overtaken it
            overtaken = self._halts != halts and isinstance(error, CommandAborted | RequestRefused)
            if not overtaken:
                self._refused = True
                await self.show_alarm()
                await self["LVIO"].show(int(getattr(error, "code", "") == "position_limit"))
            await self.show_motion()
            if overtaken:
                return Put()
            raise
        if motion is None:
            self._pending -= 1
            await self.show_motion()
            return Put() if self._halts != halts else self._overtaken()
        self._has_begun(motion, replaces)
        self.control.begun(motion, target if self.info.modulo is None else None)
        self._shown = halts  # whatever was halted before: it has a target again
        # the motion goes on when the client is gone that has put it, as it does with every motor record
        self._last = end = self._start(self._until_end(motion, halts), f"motion of {self.info.axis}")
        await self["LVIO"].show(0)
        return Put(None, asyncio.shield(end))

    async def _until_end(self, motion: Motion, halts: int) -> None:
        try:
            if self._halts != halts:  # put while the motion was on its way to the daemon
                await self.control.halt()
            ended = await motion.done()
            await self["MISS"].show(int(ended.settled is False))
        except CommandAborted as error:
            is_halted = self._halts != halts
            async with self._turn:  # what is on its way from here has begun, or was refused
                pass
            if self._begun is motion:  # not sent elsewhere: it comes to rest
                await self._rest()
                if not is_halted:
                    await self.show_beside(":message", str(error))
                    raise
        except LdcndError as error:
            await self.show_beside(":message", str(error))
            raise
        finally:
            self._pending -= 1
            await self._show_end()

    async def _show_end(self) -> None:
        """Show that a motion has ended; Move in SPMG is for one."""
        if self["SPMG"].value == "Move" and not self._pending and self._going_on is None:
            await self["SPMG"].show("Pause")
        await self.show_motion()

    async def halt(self) -> None:
        """Halt; see `BorrowedControl.halt`."""
        self._halts += 1
        self._wanted, self._distances = None, {}
        self._released.set()
        self._halting += 1
        try:
            await self.control.halt()
        finally:
            self._halting -= 1
            self._changed.set()

    async def _movable(self) -> Axis:
        axis = await self.control.taken()  # which may change the unit, and so SPMG
        self._check_may_move()
        return axis

    def _check_may_move(self) -> None:
        if self["SPMG"].value not in ("Go", "Move"):
            raise WrongState(
                f"axis {self.info.axis}: SPMG is {self['SPMG'].value}", axis=self.info.axis, remedy="put Go there"
            )


async def _then(end: Awaitable[None], field: RecordField) -> None:
    """Wait for the end of a homing, whose field is 0 from then on."""
    try:
        await end
    finally:
        await field.show(0)
