"""The contract between the daemon and all drives of one line: configuration, bring-up, what concerns them together."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import Any

from ldcnd.contract.errors import NotSupported
from ldcnd.contract.meta import ModuleInfo
from ldcnd.contract.rig_commands import CapturedInputs
from ldcnd.contract.samples import IoReading
from ldcnd.drives.driver import CountsMotion, Drive, StopMode
from ldcnd.drives.line_config import InputConfig, OutputConfig
from ldcnd.line.exchange import Poller, Timing
from ldcnd.line.proof import Proof


class StartPolicy(StrEnum):
    """How a line in an unknown state is started."""

    RESET = "reset"
    """The drives are reset: what moves loses its torque, positions count from 0."""
    ADOPT = "adopt"
    """The drives are taken over as they are, moving or not; nothing is sent that could move, stop or reset one."""


class AdoptFallback(StrEnum):
    """What happens when a line cannot be adopted."""

    REFUSE = "refuse"
    """It stays down, and the daemon says why and tries again."""
    RESET = "reset"
    """It is reset, unless a drive moves or is not known to stand."""


@dataclass(frozen=True, slots=True)
class BringUpReport:
    """How a line came up.

    Attributes:
        baud: the rate in use.
        identities: what was found, by axis name.
        reset: the drives were reset, so their positions count from 0.
        remarks: what differs from the configuration or deserves attention.
        placed: axes whose drives were powered on where they stood at that reset, so that 0 is that place;
            empty unless the line proves places.
        open_loops: axes whose drives an earlier host has left with an open loop: nothing in them would end a raw duty.
        restarted: axes whose drives had lost power, on a line that was not reset.
    """

    baud: int
    identities: Mapping[str, str]
    reset: bool
    remarks: tuple[str, ...] = ()
    placed: frozenset[str] = frozenset()
    open_loops: frozenset[str] = frozenset()
    restarted: frozenset[str] = frozenset()


@dataclass(frozen=True, slots=True)
class Instant:
    """Positions of several drives, frozen together, and what I/O modules have captured then.

    Attributes:
        counts: by axis name.
        from_s: the earliest instant at which any of them can have been frozen, on the bus's clock.
        until_s: the latest.
        io: of each I/O module with a name.
    """

    counts: Mapping[str, int]
    from_s: float
    until_s: float
    io: tuple[CapturedInputs, ...] = ()


class IoDriver(ABC):
    """An I/O module of a line.

    Attributes:
        name: as configured.
        period_s: from one poll to the next, seconds.
        inputs: its named inputs.
        outputs: lines that may be driven, by name.
        restarted: it was reset or lost its power; whoever acts upon that clears it.
        proof: that who answers is this module.
        observed: called with each reading.
        lost: called when a poll brought nothing.
        gone: called when its line is lost.
    """

    name: str
    period_s: float
    inputs: Mapping[str, InputConfig]
    outputs: Mapping[str, OutputConfig]
    restarted: bool
    proof: Proof
    observed: Callable[[IoReading, Timing], None]
    lost: Callable[[], None]
    gone: Callable[[], None]

    @abstractmethod
    async def set_outputs(
        self, levels: Mapping[int, bool], inputs: frozenset[int], pwm: tuple[float | None, float | None]
    ) -> IoReading:
        """Drive lines to levels, make others inputs, set PWM outputs; return what the pins show afterwards.

        A line that becomes an output may be low for the time between two packets.

        Raises:
            ValueOutOfRange: a line is not configured as an output.
            WrongState: what the others are is not known, and they are not named.
            BusError: the line failed.
        """

    @abstractmethod
    async def levels_to_keep(self, written: Collection[int]) -> Mapping[int, bool]:
        """Return what a request that writes these lines is to name besides, so that other lines keep their levels.

        By line the level of the pin, true for high, of what may be an output with a level not known; none where the
        lines to be written are known to be outputs, as others keep their levels then without being named.

        Raises:
            BusError: the line failed.
        """

    @abstractmethod
    async def drive(self, levels: Mapping[int, bool]) -> IoReading:
        """Set the levels of outputs, true for high; what is an input stays one, and takes no level.

        Raises:
            ValueOutOfRange: a line that is not configured as an output.
            BusError: the line failed.
        """

    @abstractmethod
    def written(self, line: int) -> bool | None:
        """Return the level that was written to a line, true for high; None when it is no output, or not known."""

    @abstractmethod
    def turning(self, lines: Iterable[int]) -> Mapping[int, bool | None]:
        """Return which of these lines are not known to be outputs, with the level that each has first as one.

        That is low; None where it may be high as well.
        """

    @abstractmethod
    def is_output(self, line: int) -> bool | None:
        """Tell whether a line is an output; None where that is not known."""

    @abstractmethod
    async def set_timer(self, *, enabled: bool, counts_edges: bool, prescale: int) -> None:
        """Run the counter or timer, one count for each `prescale` edges or clocks; the count goes on."""


class Network(ABC):
    """All drives of one line.

    Attributes:
        axes: by axis name.
        io: its I/O modules that have a name, by name.
    """

    axes: Mapping[str, Drive]
    io: Mapping[str, IoDriver] = MappingProxyType({})

    @property
    def modules(self) -> tuple[ModuleInfo, ...]:
        """The modules found on the line, by address; empty while they are not known."""
        return ()

    @property
    def watches(self) -> tuple[Poller[Any], ...]:
        """Pollers of modules that are no axes; to be added to the bus once the line is up."""
        return ()

    def incomplete(self) -> bool:
        """Tell whether something on the line has stopped answering that `rejoin` may bring back."""
        return False

    async def rejoin(
        self,
        restarted: Callable[[str], None],  # noqa: ARG002 - no drive is lost here
        heard: Callable[[str], None] = lambda _: None,  # noqa: ARG002
    ) -> frozenset[str]:
        """Bring back drives that lost power without disturbing the others; moves nothing, resets nothing that moves.

        Args:
            restarted: called with the axis whose drive had lost power, before that drive can answer again.
            heard: called with an axis whose drive answers again, as soon as it does.

        Returns:
            These axes.

        Raises:
            BusError: the line failed meanwhile.
        """
        return frozenset()

    @property
    def problem(self) -> str:
        """What keeps drives off the line that is up, and what a person has to do; empty without a problem."""
        return ""

    async def stop_together(self, mode: StopMode, names: frozenset[str]) -> None:  # noqa: B027 - optional
        """Stop axes with as few packets as the family can, before anything else that waits; not confirmed.

        Args:
            mode: see `StopMode`.
            names: axes whose loops are closed: a smooth or abrupt stop would close an open one.

        Raises:
            BusError: the line failed; each axis must be stopped by itself in any case.
        """

    async def start_group(self, motions: Mapping[str, CountsMotion], still_wanted: Callable[[], None]) -> None:  # noqa: ARG002
        """Load motions, and start them all in the same servo cycle; if one cannot be loaded nothing starts.

        Args:
            motions: by axis name; exactly the members of one group.
            still_wanted: raises when a stop has overtaken the motion; called before anything starts.

        Raises:
            NotSupported: these axes are no group.
            DriveFault: a drive is not ready; nothing started.
            OutcomeUnknown: a drive did not prove that it started; the group was stopped.
            BusError: the line failed before the start.
        """
        raise NotSupported("this family cannot start several drives together")

    async def start_path(self, names: frozenset[str], still_wanted: Callable[[], None]) -> None:  # noqa: ARG002
        """Have drives walk through the points that they hold, from the same servo cycle on.

        Args:
            names: of axes; exactly the members of one group.
            still_wanted: as for `start_group`.

        Raises:
            NotSupported, OutcomeUnknown, BusError: as `start_group`.
        """
        raise NotSupported("this family has no path mode")

    async def snapshot(self, still_free: Callable[[], None]) -> Instant:  # noqa: ARG002 - part of the contract
        """Return the positions of all axes at one instant.

        Args:
            still_free: raises while a command needs the registers; called again just before the packet that freezes.

        Raises:
            NotSupported: the family cannot, or the configuration forbids it.
            WrongState: a homing needs the registers.
            BusError: the line failed, or a drive missed the instant.
        """
        raise NotSupported("this family cannot freeze positions")

    async def let_stops_be_heard(self) -> None:
        """Have this host speak at the rate at which drives may hear a stop; their line is not up.

        Raises:
            BusError: the line failed.
        """
        return  # a line of one rate

    @abstractmethod
    async def bring_up(self) -> BringUpReport:
        """Make the drives ready to be polled, moving nothing, and prove those that were identified (`Bus.proofs`).

        Where it fails the host speaks as after `let_stops_be_heard`.

        Raises:
            NetworkMismatch: what answers is not what the configuration expects; says precisely what differs.
            BusError: the line failed meanwhile.
        """
