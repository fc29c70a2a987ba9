"""Control of an axis for a gateway whose own clients have no leases: from the first command until the axis idles.

What another program controls is never taken by force, and a gateway that idles keeps no other program out.
"""

import asyncio
from collections.abc import Awaitable, Callable

from ldcnd.client.axis import Axis
from ldcnd.client.motion import Motion, Sent, set_point
from ldcnd.client.rig import Rig
from ldcnd.contract.commands import Halt, Power
from ldcnd.contract.errors import CommandAborted, LdcndError, LeaseRequired, NotSupported, OutcomeUnknown
from ldcnd.contract.samples import StateSample, TelemetryItem

NO_HOLDER = "none"
"""Shown as who controls an axis while a gateway does not and was not refused."""
LEASE_S = 1.0
"""The axes do what their `loss.client` says so soon after the gateway is gone, in seconds."""
IDLE_S = 30.0
"""Control is given back when an axis has not moved and nothing was sent to it for so long, seconds."""


class BorrowedControl:
    """Control of one axis; `run` takes it when `taken` needs it.

    Args:
        rig: the rig.
        axis: the name of the axis.
        client: who the gateway is, a name for people.
        is_busy: tells whether the axis moves or is to move.
        on_change: called with who controls the axis now, or why it could not be had.
        on_taken: called before anything is sent under new control, which is of one run of the daemon.
    """

    def __init__(
        self,
        rig: Rig,
        axis: str,
        client: str,
        *,
        is_busy: Callable[[], bool],
        on_change: Callable[[str], Awaitable[None]],
        on_taken: Callable[[], Awaitable[None]],
    ) -> None:
        self._rig = rig
        self._name = axis
        self._client = client
        self._is_busy = is_busy
        self._on_change = on_change
        self._on_taken = on_taken
        self._axis: Axis | None = None
        self._sent: Sent | None = None
        self._holder = NO_HOLDER
        self._wanted = asyncio.Event()
        self._changed = asyncio.Event()
        self._preparing = asyncio.Lock()
        self._halts = self._offs = 0  # asked for so far
        self._used_s = 0.0  # when control was needed last, in loop time

    async def run(self) -> None:
        """Control the axis whenever that is needed, until cancelled; what it does then halts."""
        while True:
            await self._wanted.wait()
            try:
                async with self._rig.control(self._name, client=self._client, lease_s=LEASE_S) as axis:
                    await self._on_taken()
                    await self._set(axis, self._client)
                    await self._wait_idle()
                    await self._set(None, NO_HOLDER)
            except LdcndError as error:
                await self._set(None, str(error))
                task = asyncio.current_task()
                if task and task.cancelling():  # control could not be given back: the daemon is gone
                    raise asyncio.CancelledError from error

    async def taken(self) -> Axis:
        """Return the axis, under control, once all that was prepared before has taken effect.

        Raises:
            LeaseRequired: another program controls it, or the daemon does not answer.
        """
        async with self._preparing:
            return await self._take()

    async def power_on(self) -> None:
        """Close the position loop, before any motion that is commanded later: queries may overtake one another.

        Raises:
            CommandAborted: it was asked to be opened meanwhile, which came first.
            LdcndError: it was refused, or control could not be had.
        """
        offs = self._offs
        async with self._preparing:
            axis = await self._take()
            if self._offs == offs:
                await axis.power(on=True)
            if self._offs != offs:
                await self._open()  # it may have come to the daemon before it
                raise CommandAborted(
                    f"axis {self._name}: it was switched off after it was to be switched on", axis=self._name
                )

    async def reset(self) -> None:
        """Clear the latch and faults, before any motion that is commanded later.

        Raises:
            CommandAborted: it was halted or stopped meanwhile, whose latch stays.
            LdcndError: it was refused, or control could not be had.
        """
        halts = self._halts
        async with self._preparing:
            axis = await self._take()
            if self._halts != halts:
                raise CommandAborted(
                    f"axis {self._name}: it was stopped after the reset was asked for", axis=self._name
                )
            await axis.reset()

    async def _take(self) -> Axis:
        self._used_s = asyncio.get_running_loop().time()
        if self._axis is None:
            self._changed.clear()
            self._wanted.set()
            await self._changed.wait()
            self._used_s = asyncio.get_running_loop().time()
        if self._axis is None:
            raise LeaseRequired(f"axis {self._name} is not controlled by this gateway: {self._holder}", axis=self._name)
        return self._axis

    async def halt(self) -> None:
        """Halt, whatever is known here of the axis; where another program controls or moves it, stop it, which latches.

        Whether it stands, the daemon knows: a halt of an axis that does changes nothing. Nothing is asked before.

        Raises:
            OutcomeUnknown: a stop was latched, and what moves may go on.
            LdcndError: as a halt itself.
        """
        self._halts += 1
        busy, client = self._is_busy(), self._rig.client
        try:
            if self._axis is not None and not (self._axis.control and self._axis.control.lost):
                await self._axis.halt()
            elif busy or self._holder != NO_HOLDER:
                reply = await client.stop(self._name, client=self._client)
                if reply.shortfall:
                    raise OutcomeUnknown(
                        f"axis {self._name}: {reply.shortfall}", axis=self._name, remedy="look at the machine"
                    )
            else:
                await client.command(self._name, Halt(client=self._client))
        except NotSupported:  # its drive takes no halt: there is nothing to be refused where it stands
            if busy:
                raise

    async def published(self) -> tuple[int, int]:
        """Return the instants of the last state and of the last position that the daemon has published; 0 without."""
        last = [await self._rig.latest(self._name, item) for item in (TelemetryItem.STATE, TelemetryItem.POSITION)]
        state, position = (sample.t if sample else 0 for sample in last)
        return state, position

    async def power_off(self) -> None:
        """Open the position loop, which needs no control; nothing is asked before."""
        self._offs += 1
        await self._open()

    async def _open(self) -> None:
        await self._rig.client.command(self._name, Power(on=False, client=self._client))

    def begun(self, motion: Motion, asked: float | None) -> None:
        """Note the motion that was begun last; `asked` as `Sent` has it."""
        self._sent = Sent(motion.reply, self._rig.client.run, asked)

    def set_point(self, state: StateSample, here: Callable[[], float]) -> float:
        """Return where the axis was sent last, by any program, or else where it is; see `set_point` of the client."""
        return set_point(state, here, self._sent, self._rig.client.run)

    async def _set(self, axis: Axis | None, holder: str) -> None:
        self._axis, self._holder = axis, holder
        self._wanted.clear()
        self._changed.set()
        await self._on_change(holder)

    async def _wait_idle(self) -> None:
        """Wait until the axis has not moved and nothing needed control for a while.

        Raises:
            LeaseExpired: control was lost.
        """
        loop = asyncio.get_running_loop()
        while (left_s := self._used_s + IDLE_S - loop.time()) > 0:
            await asyncio.sleep(left_s)
            if self._is_busy():
                self._used_s = loop.time()
