"""A level that changes as long as the daemon does its work: for a relay outside that opens when it stops changing.

Each change is decided in the daemon's event loop and made in a thread beside it, because a driver may take milliseconds
for it. The loop hands over one change at a time and none in advance, so whatever holds up the loop, the thread, the
process or the machine ends the changes, and nothing can catch up on those that were missed.

This is no safety function: it is software on a common computer. See docs/how-to/wire-a-heartbeat.md.
"""

import asyncio
from collections.abc import Callable
from pathlib import Path

from ldcnd.config.rig import HeartbeatConfig
from ldcnd.contract.condition import assess
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.health import HeartbeatHealth
from ldcnd.contract.troubles import TroubleKind, line_troubles
from ldcnd.daemon.line import BusService
from ldcnd.daemon.rig import OwnedRig
from ldcnd.line.level import GpioLine, LevelFile, ModemLine, Output
from ldcnd.log import get_logger
from ldcnd.own_thread import OwnThread

log = get_logger("heartbeat")

HELD_S = 0.005
"""Pause before a change that a stop on its way holds is tried again: one that is confirmed at once costs no change."""
REOPEN_S = 1.0
"""Pause between two attempts to open an output that is gone."""


def open_output(config: HeartbeatConfig) -> Output:
    """Open the wire that a configuration names.

    Raises:
        ConfigError: a package is missing that it needs.
        OSError: it cannot be opened.
    """
    if config.port:
        return ModemLine(config.port, config.signal)
    if config.gpio:
        return GpioLine(config.gpio)
    return LevelFile(config.file or Path())


class Heartbeat:
    """Changes the level of one wire while the daemon's loop turns and its lines work.

    A change is held back while a line is not up, has brought no reply for `silence_s`, or does not keep to its plan;
    while a drive on it does not answer; and while a stop is not confirmed.

    Args:
        config: which wire, how fast, which lines.
        rig: what is watched.
        open_wire: opens the wire.
    """

    def __init__(
        self, config: HeartbeatConfig, rig: OwnedRig, open_wire: Callable[[HeartbeatConfig], Output] = open_output
    ) -> None:
        self._config = config
        self._open_wire = open_wire
        names = set(config.lines)
        self._lines = [bus for bus in rig.buses if not names or bus.bus.settings.name in names]
        self._replies: dict[str, tuple[int, float]] = {}
        self._level = False
        self._changes = 0
        self._why = "not started yet"

    @property
    def health(self) -> HeartbeatHealth:
        """The current state, for status requests."""
        return HeartbeatHealth(beating=not self._why, why=self._why, changes=self._changes)

    async def run(self) -> None:
        """Change the level until cancelled; an output that is gone is opened again once it is back."""
        loop = asyncio.get_running_loop()
        thread = OwnThread("heartbeat")  # a driver may hang in it
        while True:
            try:
                output = await loop.run_in_executor(thread, self._open_wire, self._config)
            except (OSError, ConfigError) as error:
                self._tell(f"the output cannot be opened: {error}")
                await asyncio.sleep(REOPEN_S)
                continue
            try:
                await self._change(output, thread)
            except OSError as error:
                self._tell(f"the output is gone: {error}")
            finally:
                loop.run_in_executor(thread, output.close)
            await asyncio.sleep(REOPEN_S)

    async def _change(self, output: Output, thread: OwnThread) -> None:
        """Change the level every half period, in step with the loop's clock and one change at a time."""
        loop = asyncio.get_running_loop()
        while True:
            self._tell(self._trouble(loop.time()))
            if not self._why:
                self._level = not self._level
                await loop.run_in_executor(thread, output.set, self._level)
                self._changes += 1
            stops = (axis.tracker.status for line in self._lines for axis in line.axes if axis.tracker.status.stop)
            is_soon_over = bool(self._why) and any(not status.stop_due for status in stops)
            await asyncio.sleep(HELD_S if is_soon_over else self._config.half_period_ms / 1000)

    def _trouble(self, now_s: float) -> str:
        """Return why the level must stay as it is, or nothing."""
        if not self._lines:
            return "no line is watched"
        for line in self._lines:
            if trouble := self._trouble_of(line, now_s):
                return trouble
        return ""

    def _trouble_of(self, line: BusService, now_s: float) -> str:
        name, silence_s = line.bus.settings.name, self._config.silence_ms / 1000
        replies = line.bus.statistics.replies
        before, since_s = self._replies.get(name, (replies, now_s))
        if replies != before:
            since_s = now_s
        self._replies[name] = (replies, since_s)
        for trouble in line_troubles(up=line.report is not None):
            return f"{name}: {trouble.text}"
        if now_s - since_s > silence_s:
            return f"{name}: no reply for more than {silence_s:g} s"
        if not line.bus.on_time(now_s):
            return f"{name}: the line does not keep to its plan"
        for axis in line.axes:
            if axis.tracker.status.stop:
                return f"{axis.config.name}: a stop is not confirmed"
            for trouble in assess(axis.tracker.status).troubles:
                # faults and latched stops are the drive's own and the machine's business
                if trouble.kind is TroubleKind.NO_ANSWER:
                    return f"{axis.config.name}: {trouble.text}"
        return ""

    def _tell(self, why: str) -> None:
        if why != self._why:
            self._why = why
            if why:
                log.warning("heartbeat held", reason=why)
            else:
                log.info("heartbeat", half_period_ms=self._config.half_period_ms)
