"""One step of commissioning: what it will do in words, how it is run, and what a running step has at hand."""

import asyncio
from abc import ABC, abstractmethod
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass
from typing import ClassVar

from ldcnd.bench.commissioning.record import CommissioningRecord, Result, StepState
from ldcnd.bench.kept_gains import open_loop
from ldcnd.bench.person import Person
from ldcnd.client.axis import Axis, at_rest
from ldcnd.client.motion import Motion, State
from ldcnd.client.rest import REST_S
from ldcnd.client.rig import Rig
from ldcnd.contract.codec import rebuild_error
from ldcnd.contract.commands import Verb
from ldcnd.contract.errors import CommandAborted, LdcndError, Remedy, StopLatched, WrongState, step
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.questions import PreviewReply
from ldcnd.drives.axis_config import AxisConfig

STILL_COUNTS = 2
"""Two positions that differ by no more are the same place."""


@dataclass(frozen=True, kw_only=True, slots=True)
class AxisContext:
    """What decides whether a step is for an axis.

    Attributes:
        info: the axis, as the daemon describes it.
        config: the axis, as the file has it.
    """

    info: AxisInfo
    config: AxisConfig


@dataclass(frozen=True, kw_only=True, slots=True)
class StepContext(AxisContext):
    """What a step works on.

    Attributes:
        rig: of the axis.
        person: answers, and allows motion.
        record: what is known of the axis so far.
    """

    rig: Rig
    person: Person
    record: CommissioningRecord

    @property
    def counts_per_unit(self) -> float:
        """Encoder counts in an axis unit, without sign."""
        return self.info.counts_per_unit or 1.0

    def length(self, units: float) -> str:
        """Return a length with its unit."""
        return f"{units:.6g} {self.info.unit}"


class Step(ABC):
    """A step: stateless, one instance for all axes."""

    name: ClassVar[str]
    """In the record and behind `--step`."""
    title: ClassVar[str]
    about: ClassVar[str]
    """What it will do, in words."""
    moves: ClassVar[bool] = True
    """Whether it needs control over the axis."""
    needs: ClassVar[tuple[Verb, ...]] = ()
    """Commands without which it is not possible."""
    depends: ClassVar[tuple[str, ...]] = ()
    """Settings of the axis, such as `direction`, whose change opens it again; the drive's identity always does."""

    def obstacle(self, site: AxisContext) -> str:
        """Return why it is not possible with this axis; empty when it is."""
        missing = [verb.value for verb in self.needs if verb not in site.info.capabilities]
        return f"not possible on this model: a {site.info.model} has no {', '.join(missing)}" if missing else ""

    def unneeded(self, site: AxisContext) -> str:  # noqa: ARG002 - most steps are needed
        """Return why there is nothing to do; empty when there is."""
        return ""

    async def preview(self, site: StepContext) -> tuple[str, ...]:
        """Return what would move, how far, how fast, and which limits catch it.

        Raises:
            LdcndError: it would be refused now.
        """
        return (f"nothing moves: {site.info.axis} stays as it is",)

    @abstractmethod
    async def run(self, site: StepContext, axis: Axis) -> Result:
        """Carry it out.

        Args:
            site: what it works on.
            axis: under control of this program if the step moves; only watched otherwise.

        Raises:
            LdcndError: it has failed; what moved was halted.
            Left: the person has left; likewise.
        """


def done(text: str) -> Result:
    """Return the result of a step that has nothing but words to keep."""
    return Result(state=StepState.DONE, text=text)


def refuse_latched(axis: Axis) -> None:
    """Raise if a stop is latched.

    Raises:
        StopLatched: only a person clears it.
    """
    if axis.state.stop_latched:
        raise StopLatched(
            f"axis {axis.name}: a stop is latched", axis=axis.name, remedy=Remedy("{}", step("reset", "reset it"))
        )


async def rest_counts(axis: Axis) -> int:
    """Wait until an axis stands, by two positions of which neither is older than this call; return it in counts.

    Raises:
        WrongState: it does not come to rest, or its positions are not published.
    """
    await at_rest(axis, watched=True)
    try:
        async with asyncio.timeout(REST_S):
            positions = axis.positions()
            last = (await anext(positions)).counts
            while abs((counts := (await anext(positions)).counts) - last) > STILL_COUNTS:
                last = counts
    except TimeoutError:
        raise WrongState(
            f"axis {axis.name}: no two positions within {REST_S:g} s that agree",
            axis=axis.name,
            remedy="set `rates.position` to 10 or more",
        ) from None
    return counts


@asynccontextmanager
async def closed_loop(site: StepContext, axis: Axis) -> AsyncIterator[int]:
    """Close the loop of an axis for the motions of a step; yield where it stood before, in counts.

    It stays closed, because a load could fall without it. A step that ends before the axis has moved leaves it as it
    found it: an open loop is opened again.

    Raises:
        WrongState: the axis does not come to rest before.
        LdcndError: as the daemon refused it.
    """
    was_closed, before = axis.state.enabled, await rest_counts(axis)
    try:
        await axis.power(on=True)
        yield before
    except BaseException:
        if not (axis.control and axis.control.lost):  # then the daemon sees to it
            with suppress(LdcndError):
                await axis.halt()  # also a motion whose reply was not waited for
                stands = abs(await rest_counts(axis) - before) <= STILL_COUNTS
                if stands and not was_closed:
                    await open_loop(axis)
                elif not stands:
                    opens = step("power", f"ldcnd power off {axis.name}", on=False)
                    said = site.person.named(opens, axis.name)
                    site.person.tell(f"{axis.name} holds its position: `{said}` opens its loop")
        raise


def refuse_previewed(reply: PreviewReply) -> None:
    """Raise what the daemon says against the values of a motion; obstacles that a step clears itself are none.

    Raises:
        LdcndError: as the daemon would refuse it.
        WrongState: the axis would come to its goal by two motions.
    """
    if reply.refusal:
        raise rebuild_error(reply.refusal)
    if reply.approach_from is not None:
        raise WrongState(
            f"axis {reply.axis} comes to its goals from one side (`approach`)",
            axis=reply.axis,
            remedy="take `approach` out of the configuration while it is commissioned",
        )


async def moved_while_held(
    axis: Axis,
    move: Callable[[], Awaitable[Motion]],
    released: asyncio.Event,
    beside: Callable[[], Coroutine[None, None, None]] | None = None,
) -> tuple[Motion, State] | None:
    """Make one motion; None when the key was released before it had ended: then the axis stands.

    Nothing is begun once the key is released: a step of several motions asks before each.

    Args:
        axis: which moves.
        move: begins the motion.
        released: is set when the key is.
        beside: runs meanwhile, is cancelled at the end, and raises nothing itself.

    Raises:
        LdcndError: it was refused, or has ended otherwise.
    """
    if released.is_set():
        return None
    motion = await move()
    async with asyncio.TaskGroup() as group:
        ended = group.create_task(_ended(motion), name=f"motion of {axis.name}")
        let_go = group.create_task(released.wait(), name="released key")
        watching = group.create_task(beside(), name=f"watch {axis.name}") if beside else None
        await asyncio.wait((ended, let_go), return_when=asyncio.FIRST_COMPLETED)
        let_go.cancel()
        if watching:
            watching.cancel()
        if not ended.done():
            ended.cancel()  # which halts the axis
    if ended.cancelled():
        await at_rest(axis, watched=True)
        return None
    outcome = ended.result()
    if isinstance(outcome, LdcndError):
        raise outcome
    return motion, outcome


def key_released(axis: Axis) -> CommandAborted:
    """Return the error of a step whose key was released before it had what it needs."""
    return CommandAborted(f"axis {axis.name}: the key was let go", axis=axis.name, remedy="run the step again")


async def _ended(motion: Motion) -> State | LdcndError:
    try:
        return await motion.done()
    except LdcndError as error:
        return error
