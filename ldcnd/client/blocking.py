"""The client for programs without an event loop: the same calls, each of which waits for its result.

Nothing is implemented twice: a call runs the asyncio client's own method on a loop in a thread of its own, and has its
arguments, its result and its errors. Safe to use from several threads. An interrupted wait for a motion halts the axis.
"""

from collections.abc import Callable, Coroutine, Iterator, Mapping, Sequence
from contextlib import AbstractAsyncContextManager, AbstractContextManager, contextmanager
from functools import wraps
from pathlib import Path
from typing import Any, Concatenate, Generic, ParamSpec, TypeVar, overload

from ldcnd.client import axis as asynchronous
from ldcnd.client import jog, motion, rig
from ldcnd.client.fleet import RigReport, survey
from ldcnd.client.loop_thread import LoopThread, loop_thread
from ldcnd.client.notebook import table
from ldcnd.contract.events import CommandEvent
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.rig_commands import LinePath
from ldcnd.contract.samples import PositionSample, Sample
from ldcnd.net.zenoh_session import open_zenoh_session
from ldcnd.net.zenoh_settings import ZenohSettings

P = ParamSpec("P")
ResultT = TypeVar("ResultT")
WrappedT = TypeVar("WrappedT")


class Facade(Generic[WrappedT]):
    """Base of the facades: an object of the asyncio client, and the loop on which it runs."""

    def __init__(self, loop: LoopThread, wrapped: WrappedT) -> None:
        self._loop = loop
        self._wrapped = wrapped

    def __repr__(self) -> str:
        return repr(self._wrapped)


def _waiting(
    method: Callable[Concatenate[WrappedT, P], Coroutine[Any, Any, ResultT]],
) -> Callable[Concatenate[Facade[WrappedT], P], ResultT]:
    """Return a method that waits for the result of another one."""

    @wraps(method)
    def call(facade: Facade[WrappedT], /, *args: P.args, **kwargs: P.kwargs) -> ResultT:
        return facade._loop.run(method(facade._wrapped, *args, **kwargs))  # noqa: SLF001 - the facade is ours

    return call


def _moving(
    method: Callable[Concatenate[WrappedT, P], Coroutine[Any, Any, motion.Motion]],
) -> Callable[Concatenate[Facade[WrappedT], P], "BlockingMotion"]:
    """Return a method that waits until the drive has acknowledged a motion."""

    @wraps(method)
    def call(facade: Facade[WrappedT], /, *args: P.args, **kwargs: P.kwargs) -> BlockingMotion:
        return BlockingMotion(facade._loop, facade._loop.run(method(facade._wrapped, *args, **kwargs)))  # noqa: SLF001

    return call


class BlockingMotion(Facade[motion.Motion]):
    """A command that the drive has acknowledged and that ends later."""

    done = _waiting(motion.Motion.done)

    def __iter__(self) -> Iterator[motion.Progress]:
        """Yield the progress with each value that arrives until the command has ended."""
        return self._loop.each(aiter(self._wrapped))


class BlockingJogging(Facade[jog.Jogging]):
    """A jog under way; made by `BlockingAxis.jogging`."""

    held = _waiting(jog.Jogging.held)
    renew = _waiting(jog.Jogging.renew)


class BlockingAxis(Facade[asynchronous.Axis]):
    """An axis that a program controls or watches; a method for each verb, as `ldcnd.Axis` has."""

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
    """A rig that a program uses; made by `connect`."""

    stop = _waiting(rig.Rig.stop)
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
    ) -> AbstractContextManager[BlockingAxis]: ...

    @overload
    def control(
        self, first: str, second: str, /, *more: str, client: str, lease_s: float = 1.0, force: bool = False
    ) -> AbstractContextManager[tuple[BlockingAxis, ...]]: ...

    def control(
        self, *axes: str, client: str, lease_s: float = 1.0, force: bool = False
    ) -> AbstractContextManager[BlockingAxis] | AbstractContextManager[tuple[BlockingAxis, ...]]:
        """Control axes until the context ends; see `ldcnd.Rig.control`."""
        held = self._axes(self._wrapped.controlled(axes, client, lease_s, force=force))
        return _only(held) if len(axes) == 1 else held

    @overload
    def watch(self, axis: str, /) -> AbstractContextManager[BlockingAxis]: ...

    @overload
    def watch(self, first: str, second: str, /, *more: str) -> AbstractContextManager[tuple[BlockingAxis, ...]]: ...

    def watch(
        self, *axes: str
    ) -> AbstractContextManager[BlockingAxis] | AbstractContextManager[tuple[BlockingAxis, ...]]:
        """Watch axes until the context ends; see `ldcnd.Rig.watch`."""
        watched = self._axes(self._wrapped.watched(axes))
        return _only(watched) if len(axes) == 1 else watched

    @contextmanager
    def events(self, axis: str | None = None, *, history: bool = False) -> Iterator[Iterator[CommandEvent]]:
        """Follow what happens to commands; see `ldcnd.Rig.events`."""
        with self._loop.inside(self._wrapped.events(axis, history=history)) as following:
            yield self._loop.each(following)

    @contextmanager
    def samples(self, axis: str = "*", item: str = "*") -> Iterator[Iterator[tuple[str, Sample]]]:
        """Take telemetry of any item: pairs of the axis and its sample."""
        with self._loop.inside(self._wrapped.samples(axis, item)) as samples:
            yield self._loop.each(samples)

    @contextmanager
    def _axes(
        self, context: AbstractAsyncContextManager[tuple[asynchronous.Axis, ...]]
    ) -> Iterator[tuple[BlockingAxis, ...]]:
        with self._loop.inside(context) as axes:
            yield tuple(BlockingAxis(self._loop, axis) for axis in axes)

    def _repr_html_(self) -> str:
        """Return the axes as a table, for notebooks."""
        rows = [(axis.axis, axis.model, axis.unit) for axis in self.describe()]
        return table(f"rig {self.name}", rows, ("axis", "drive", "unit"))


@contextmanager
def connect(
    endpoint: str | None = None, *, rig: str | None = None, config: Path | str | None = None
) -> Iterator[BlockingRig]:
    """Use one rig for as long as the context lasts; see `ldcnd.connect`."""
    with loop_thread() as loop, loop.inside(_connect(endpoint, rig=rig, config=config)) as found:
        yield BlockingRig(loop, found)


def fleet(settings: ZenohSettings, rig: str | None = None) -> tuple[RigReport, ...]:
    """Return how every rig is that can be reached."""
    with loop_thread() as loop, loop.inside(open_zenoh_session(settings)) as session:
        return loop.run(survey(session, rig))


_connect = rig.connect


@contextmanager
def _only(axes: AbstractContextManager[tuple[BlockingAxis, ...]]) -> Iterator[BlockingAxis]:
    with axes as found:
        yield found[0]
