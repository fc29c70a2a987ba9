"""The client for programs without an event loop: the same calls, each of which waits for its result.

Nothing is implemented twice: a call runs the asyncio client's own method on a loop in a thread of its own, and has its
arguments, its result and its errors. Safe to use from several threads. An interrupted wait for a motion halts the axis.
"""

import atexit
from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, AbstractContextManager, ExitStack, contextmanager
from functools import wraps
from pathlib import Path
from types import TracebackType
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar, overload

from ldcnd.client import axis as asynchronous
from ldcnd.client import motion, rig
from ldcnd.client.loop_thread import LENT, LoopThread, loop_thread
from ldcnd.client.notebook import table
from ldcnd.client.traces import Trace
from ldcnd.contract.events import CommandEvent
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.rig_commands import LinePath
from ldcnd.contract.samples import PositionSample, Sample

P = ParamSpec("P")
ResultT = TypeVar("ResultT")
WrappedT_co = TypeVar("WrappedT_co", covariant=True)


class Facade(Generic[WrappedT_co]):
    """Base of the facades: an object of the asyncio client, and the loop on which it runs."""

    def __init__(self, loop: LoopThread, wrapped: WrappedT_co) -> None:
        self._loop = loop
        self._wrapped = wrapped

    def __repr__(self) -> str:
        return repr(self._wrapped)


def _waiting(
    method: Callable[Concatenate[WrappedT_co, P], Coroutine[Any, Any, ResultT]],
) -> Callable[Concatenate[Facade[WrappedT_co], P], ResultT]:
    """Return a method that waits for the result of another one."""

    @wraps(method)
    def call(facade: Facade[WrappedT_co], /, *args: P.args, **kwargs: P.kwargs) -> ResultT:
        return facade._loop.run(method(facade._wrapped, *args, **kwargs))  # noqa: SLF001 - the facade is ours

    return call


def _moving(
    method: Callable[Concatenate[WrappedT_co, P], Coroutine[Any, Any, motion.Motion]],
) -> Callable[Concatenate[Facade[WrappedT_co], P], "BlockingMotion"]:
    """Return a method that waits until the drive has acknowledged a motion."""

    @wraps(method)
    def call(facade: Facade[WrappedT_co], /, *args: P.args, **kwargs: P.kwargs) -> BlockingMotion:
        return BlockingMotion(facade._loop, facade._loop.run(method(facade._wrapped, *args, **kwargs)))  # noqa: SLF001

    return call


class BlockingMotion(Facade[motion.Motion]):
    """A command that the drive has acknowledged and that ends later."""

    done = _waiting(motion.Motion.done)

    def __iter__(self) -> Iterator[motion.Progress]:
        """Yield the progress with each value that arrives until the command has ended."""
        return self._loop.each(aiter(self._wrapped))

    def _repr_html_(self) -> str:
        """Return what it is and how it has ended as a table, for notebooks."""
        return self._wrapped._repr_html_()


class BlockingJogging(Facade[motion.Jogging]):
    """A jog under way; made by `BlockingAxis.jogging`."""

    held = _waiting(motion.Jogging.held)
    renew = _waiting(motion.Jogging.renew)


class BlockingAxis(Facade[asynchronous.Axis]):
    """An axis that a program controls or watches; a method for each verb, as `ldcnd.Axis` has."""

    def __init__(self, loop: LoopThread, wrapped: asynchronous.Axis, close: Callable[[], None]) -> None:
        super().__init__(loop, wrapped)
        self._close = close

    def close(self) -> None:
        """Give up control, or watch no more, as at the end of a context: with all axes of it; once is enough."""
        self._close()

    # made by `python -m tools client`: begin
    power = _waiting(asynchronous.Axis.power)
    move_absolute = _moving(asynchronous.Axis.move_absolute)
    move_relative = _moving(asynchronous.Axis.move_relative)
    move_velocity = _moving(asynchronous.Axis.move_velocity)
    jog = _moving(asynchronous.Axis.jog)
    halt = _moving(asynchronous.Axis.halt)
    quick_stop = _waiting(asynchronous.Axis.quick_stop)
    home = _moving(asynchronous.Axis.home)
    probe = _moving(asynchronous.Axis.probe)
    reset = _waiting(asynchronous.Axis.reset)
    set_position = _waiting(asynchronous.Axis.set_position)
    set_gains = _waiting(asynchronous.Axis.set_gains)
    list_parameters = _waiting(asynchronous.Axis.list_parameters)
    read_parameter = _waiting(asynchronous.Axis.read_parameter)
    read_all_parameters = _waiting(asynchronous.Axis.read_all_parameters)
    write_parameter = _waiting(asynchronous.Axis.write_parameter)
    clear_counter = _waiting(asynchronous.Axis.clear_counter)
    restart_eeprom_count = _waiting(asynchronous.Axis.restart_eeprom_count)
    read_alarms = _waiting(asynchronous.Axis.read_alarms)
    read_monitors = _waiting(asynchronous.Axis.read_monitors)
    plan_parameters = _waiting(asynchronous.Axis.plan_parameters)
    move_analog = _moving(asynchronous.Axis.move_analog)
    set_pwm = _moving(asynchronous.Axis.set_pwm)
    track = _moving(asynchronous.Axis.track)
    set_outputs = _waiting(asynchronous.Axis.set_outputs)
    abort_trace = _waiting(asynchronous.Axis.abort_trace)
    why = _waiting(asynchronous.Axis.why)
    preview = _waiting(asynchronous.Axis.preview)
    report_shadow = _waiting(asynchronous.Axis.report_shadow)

    # made by `python -m tools client`: end

    stop = _waiting(asynchronous.Axis.stop)
    take_trace = _waiting(asynchronous.Axis.take_trace)
    at = _waiting(asynchronous.Axis.at)
    between = _waiting(asynchronous.Axis.between)

    @contextmanager
    def tracing(
        self, *channels: str, samples: int = 500, interval_s: float | None = None
    ) -> Iterator[Callable[[float], Trace]]:
        """Record what happens in the context; yields a function that waits for the trace, so many seconds at most."""
        arming = self._wrapped.tracing(*channels, samples=samples, interval_s=interval_s)
        with self._loop.inside(arming) as taken:
            yield lambda within_s: self._loop.run(taken(within_s))

    @contextmanager
    def jogging(
        self, velocity: float, *, acceleration: float | None = None, hold_s: float = 0.4
    ) -> Iterator[BlockingJogging]:
        """Jog while `BlockingJogging.held` is called; the end of the context halts the axis, whatever ends it."""
        jogging = self._wrapped.jogging(velocity, acceleration=acceleration, hold_s=hold_s)
        with self._loop.inside(jogging) as begun:
            yield BlockingJogging(self._loop, begun)

    @property
    def name(self) -> str:
        """Its name."""
        return self._wrapped.name

    @property
    def state(self) -> motion.State:
        """The last state."""
        return self._wrapped.state

    @property
    def position(self) -> motion.Position:
        """The last position."""
        return self._wrapped.position

    @property
    def target(self) -> float:
        """Where it was sent last, by any program; where it is, once anything else stopped or moved it."""
        return self._wrapped.target

    def positions(self) -> Iterator[PositionSample]:
        """Iterate over the positions that come from now on."""
        return self._loop.each(self._wrapped.positions())

    def _repr_html_(self) -> str:
        """Return what is known of it as a table, for notebooks."""
        return self._wrapped._repr_html_()


class BlockingRig(Facade[rig.Rig]):
    """A rig that a program uses; made by `connect`, and by `ldcnd.open`."""

    def __init__(self, loop: LoopThread, wrapped: rig.Rig, close: Callable[[], None], opened: ExitStack) -> None:
        super().__init__(loop, wrapped)
        self._close = close
        self._opened = opened

    def close(self) -> None:
        """Leave the rig, which gives up control over its axes; once is enough."""
        self._close()

    stop = _waiting(rig.Rig.stop)
    at = _waiting(rig.Rig.at)
    between = _waiting(rig.Rig.between)
    daemon = _waiting(rig.Rig.daemon)
    describe = _waiting(rig.Rig.describe)
    buses = _waiting(rig.Rig.buses)
    faults = _waiting(rig.Rig.faults)
    states = _waiting(rig.Rig.states)
    holders = _waiting(rig.Rig.holders)
    outcome = _waiting(rig.Rig.outcome)
    latest = _waiting(rig.Rig.latest)
    snapshot = _waiting(rig.Rig.snapshot)
    set_io = _waiting(rig.Rig.set_io)
    set_io_timer = _waiting(rig.Rig.set_io_timer)
    override_interlock = _waiting(rig.Rig.override_interlock)
    send_guest_away = _waiting(rig.Rig.send_guest_away)

    @property
    def name(self) -> str:
        """Its name."""
        return self._wrapped.name

    @property
    def axes(self) -> tuple[str, ...]:
        """The names of its axes."""
        return self._wrapped.axes

    def follow_descriptions(self) -> Iterator[Mapping[str, AxisInfo]]:
        """Yield what every axis is by its name: at once, and soon after each reload and restart of the daemon."""
        return self._loop.each(self._wrapped.follow_descriptions())

    preview_together = _waiting(rig.Rig.preview_together)
    set_speed_override = _waiting(rig.Rig.set_speed_override)
    reload = _waiting(rig.Rig.reload)

    def move_together(
        self,
        targets: dict[str, float],
        *,
        velocity: float | None = None,
        acceleration: float | None = None,
        path: LinePath = LinePath.INDEPENDENT,
        max_deviation: float | None = None,
    ) -> tuple[BlockingMotion, ...]:
        """Start absolute moves of the members of one group in the same servo cycle; see `ldcnd.Rig.move_together`."""
        moves = self._wrapped.move_together(
            targets, velocity=velocity, acceleration=acceleration, path=path, max_deviation=max_deviation
        )
        return tuple(BlockingMotion(self._loop, move) for move in self._loop.run(moves))

    def path(
        self,
        corners: dict[str, Sequence[float]],
        *,
        speed: float | None = None,
        velocity: float | None = None,
        acceleration: float | None = None,
        max_deviation: float | None = None,
    ) -> tuple[BlockingMotion, ...]:
        """Walk the members of one group along a polyline; see `ldcnd.Rig.path`."""
        motions = self._wrapped.path(
            corners, speed=speed, velocity=velocity, acceleration=acceleration, max_deviation=max_deviation
        )
        return tuple(BlockingMotion(self._loop, motion) for motion in self._loop.run(motions))

    @overload
    def control(
        self, axis: str, /, *, client: str, lease_s: float = 1.0, force: bool = False
    ) -> "Opened[BlockingAxis]": ...

    @overload
    def control(
        self, first: str, second: str, /, *more: str, client: str, lease_s: float = 1.0, force: bool = False
    ) -> "Opened[tuple[BlockingAxis, ...]]": ...

    def control(
        self, *axes: str, client: str, lease_s: float = 1.0, force: bool = False
    ) -> "Opened[BlockingAxis] | Opened[tuple[BlockingAxis, ...]]":
        """Control axes until the context ends, or until `close` after `open`; see `ldcnd.Rig.control`."""
        held = self._axes(self._wrapped.controlled(axes, client, lease_s, force=force))
        return Opened(_only(held), self._opened) if len(axes) == 1 else Opened(held, self._opened)

    @overload
    def watch(self, axis: str, /) -> "Opened[BlockingAxis]": ...

    @overload
    def watch(self, first: str, second: str, /, *more: str) -> "Opened[tuple[BlockingAxis, ...]]": ...

    def watch(self, *axes: str) -> "Opened[BlockingAxis] | Opened[tuple[BlockingAxis, ...]]":
        """Watch axes until the context ends, or until `close` after `open`; see `ldcnd.Rig.watch`."""
        watched = self._axes(self._wrapped.watched(axes))
        return Opened(_only(watched), self._opened) if len(axes) == 1 else Opened(watched, self._opened)

    def events(self, axis: str | None = None, *, history: bool = False) -> "BlockingStream[CommandEvent]":
        """Follow what happens to commands: `for event in rig.events()`; see `ldcnd.Rig.events`."""
        return BlockingStream(self._loop, self._wrapped.events(axis, history=history))

    def samples(self, axis: str = "*", item: str = "*") -> "BlockingStream[tuple[str, Sample]]":
        """Take telemetry of any item: `for axis, sample in rig.samples()`; see `ldcnd.Rig.samples`."""
        return BlockingStream(self._loop, self._wrapped.samples(axis, item))

    @contextmanager
    def _axes(
        self, context: AbstractAsyncContextManager[tuple[asynchronous.Axis, ...]]
    ) -> Iterator[tuple[BlockingAxis, ...]]:
        with ExitStack() as entered:
            axes = entered.enter_context(self._loop.inside(context))
            yield tuple(BlockingAxis(self._loop, axis, entered.close) for axis in axes)

    def _repr_html_(self) -> str:
        """Return the axes as a table, for notebooks."""
        rows = [(axis.axis, axis.model, axis.unit) for axis in self.describe()]
        return table(f"rig {self.name}", rows, ("axis", "drive", "unit"))


class BlockingStream(Generic[ResultT]):
    """What arrives from now on: to be iterated over, or to be entered, which yields an iterator until it is left."""

    def __init__(self, loop: LoopThread, stream: rig.Stream[ResultT]) -> None:
        self._loop = loop
        self._stream = stream
        self._entered = ExitStack()

    def __enter__(self) -> Iterator[ResultT]:
        return self._loop.each(self._entered.enter_context(self._loop.inside(self._stream)))

    def __exit__(self, *_error: object) -> None:
        self._entered.close()

    def __iter__(self) -> Iterator[ResultT]:
        """Yield each item for as long as the loop goes on."""
        with self as items:
            yield from items


class Opened(AbstractContextManager[ResultT, None]):
    """What lasts as long as a context; or, in a notebook, from `open` to `close`, in which it may be used in any cell.

    What is still open when the program ends is closed then.
    """

    def __init__(self, context: AbstractContextManager[ResultT], within: ExitStack | None = None) -> None:
        self._context = context
        self._within = within  # what was opened and is not closed is closed with it
        self._entered = ExitStack()

    def __enter__(self) -> ResultT:
        return self._entered.enter_context(self._context)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._entered.__exit__(kind, error, trace)

    def open(self) -> ResultT:
        """Begin; the caller closes it."""
        value = self.__enter__()
        if self._within:
            self._within.callback(self.close)
            return value
        lent = LENT.get()  # the loop of a rehearsal ends long before the interpreter does
        if lent:
            lent.close_later(self.close)
        else:
            atexit.register(self.close)
        return value

    def close(self) -> None:
        """End; once is enough."""
        atexit.unregister(self.close)
        self._entered.close()


def connect(
    endpoint: str | None = None, *, rig: str | None = None, config: Path | str | None = None, wait_s: float = 0.0
) -> Opened[BlockingRig]:
    """Use one rig for as long as the context lasts, or until `close` after `open`; see `ldcnd.connect`."""
    return Opened(_rig(endpoint, rig, config, wait_s))


def open_rig(
    endpoint: str | None = None, *, rig: str | None = None, config: Path | str | None = None, wait_s: float = 0.0
) -> BlockingRig:
    """Use one rig until its `close`, for notebooks; see `ldcnd.connect`."""
    return connect(endpoint, rig=rig, config=config, wait_s=wait_s).open()


@contextmanager
def _rig(endpoint: str | None, name: str | None, config: Path | str | None, wait_s: float) -> Iterator[BlockingRig]:
    connected = rig.connect(endpoint, rig=name, config=config, wait_s=wait_s)
    with ExitStack() as entered:
        loop = entered.enter_context(loop_thread())
        there = entered.enter_context(loop.inside(connected))
        yield BlockingRig(loop, there, entered.close, entered.enter_context(ExitStack()))


@contextmanager
def _only(axes: AbstractContextManager[tuple[BlockingAxis, ...]]) -> Iterator[BlockingAxis]:
    with axes as found:
        yield found[0]
