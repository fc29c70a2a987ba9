"""What forbids an axis to move until it is reset, beyond the life of the daemon: a latched stop, and error_stop.

Both are kept from when they come, and a stop is answered once its latch is on the disk, or after `WITHIN_S`. The
next daemon begins with them, and has what was stopped stopped again: its drive may not have been sent the stop before
the daemon was killed. Where the file cannot be read, or may be older than a stop, as one of a backup or of a directory
that was not in use last, every axis is latched; so is one whose drive the file does not name.
"""

import asyncio
import contextlib
from collections.abc import Callable, Iterator, Mapping
from datetime import UTC, datetime

from ldcnd.axis.events import LatchRecalled
from ldcnd.axis.kept import KeptFiles, KeptLatch
from ldcnd.axis.status import AxisStatus, LatchedBy
from ldcnd.axis.tracker import AxisTracker
from ldcnd.contract.samples import AxisState
from ldcnd.drives.driver import StopMode
from ldcnd.durable import DamagedFile
from ldcnd.log import get_logger

WITHIN_S = 0.5
"""Longest delay of the answer of a stop, and of the end of the daemon, for the disk, seconds."""
UNNAMED = (
    "latched: no record says whether its drive was stopped, as the axis had another line, address or name; look at it,"
    " then send reset"
)
"""Reason of the latch of an axis whose drive the file does not name."""
RETRY_S = 5.0
"""Delay before latches are written again that could not be, seconds."""
log = get_logger("latches")


class LatchKeeper:
    """Keeps the latches of one rig."""

    def __init__(self, files: KeptFiles | None, trackers: Mapping[str, AxisTracker], now_ns: Callable[[], int]) -> None:
        """Take up what an earlier daemon has kept.

        Args:
            files: where it is kept; None where nothing is.
            trackers: of the axes that can be stopped, by name.
            now_ns: returns the time, UTC in ns since 1970.
        """
        self._files = files
        self._trackers = trackers
        self._changed = asyncio.Event()
        self._writing = asyncio.Lock()
        self._on_disk: Mapping[str, KeptLatch] | None = {}  # None: not known
        self._others: dict[str, KeptLatch] = {}  # of axes that are not configured now
        self._recalled: dict[str, tuple[KeptLatch, str]] = {}  # with what is said of it
        if files is None:
            return
        for tracker in trackers.values():
            tracker.watch(self._watch, "stop_latched", "latched_by", "stop", "state")
        doubt = dict[str, str]()
        try:
            file = files.latches()
        except DamagedFile as error:
            log.error("kept latches are not to be trusted: every axis is latched, send reset", reason=str(error))
            doubt = dict.fromkeys(trackers, f"latched, because the kept latches are not to be trusted: {error}")
            file = self._on_disk = None
        else:
            # a directory without a file of them gets one, by which a backup is known later
            self._on_disk = file.axes if file and file.places == files.places else None
        kept = dict(file.axes) if file else {}
        if file and file.places:
            unnamed = [name for name in trackers if file.places.get(name) != files.places[name]]
            doubt = {name: UNNAMED for name in unnamed if name not in kept or not kept[name].stopped}
        for name in doubt:
            kept[name] = kept.get(name, KeptLatch()).model_copy(update={"stopped": True})
        self._others = {name: latch for name, latch in kept.items() if name not in trackers}
        for name in sorted(kept.keys() & trackers.keys()):
            latch = kept[name]
            again = latch.again or (StopMode.SMOOTH if latch.stopped else None)
            by = None if latch.since is None else LatchedBy(latch.since, latch.client, latch.login)
            trackers[name].take(
                LatchRecalled(
                    latch.stopped, again, latch.in_error, latch.first_fault, now_ns(), confirmed=latch.confirmed, by=by
                )
            )
            self._recalled[name] = latch, doubt.get(name) or _in_words(latch)
            log.warning("latched since an earlier daemon", axis=name, stopped=latch.stopped, in_error=latch.in_error)

    def _watch(self, before: AxisStatus, after: AxisStatus) -> None:
        in_error = AxisState.ERROR_STOP in (before.state, after.state)
        fields = ("stop_latched", "latched_by", "stop")
        if in_error or any(getattr(after, name) is not getattr(before, name) for name in fields):
            self._changed.set()  # perhaps in vain: what is kept is compared before it is written

    def recalled_stops(self) -> Iterator[tuple[str, KeptLatch, str]]:
        """Yield the stops that were taken up: the axis, the latch as it was kept, and what is said of it."""
        for name, (latch, said) in self._recalled.items():
            if latch.stopped:
                yield name, latch, said

    async def run(self) -> None:
        """Keep what comes and goes until cancelled; without a place for it there is nothing to do."""
        while self._files is not None:
            kept = await self._keep(self._files)
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(None if kept else RETRY_S):
                    await self._changed.wait()

    async def settled(self) -> None:
        """Return once what is latched is on the disk, or is not in time."""
        if self._files is None:
            return
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(WITHIN_S):
                await self._keep(self._files)

    def holds(self, axis: str) -> bool:
        """Tell whether the stop of an axis is on the disk."""
        latch = (self._on_disk or {}).get(axis)
        return latch is not None and latch.stopped

    async def _keep(self, files: KeptFiles) -> bool:
        """Write the latches unless they are on the disk as they are; tell whether they are."""
        async with self._writing:  # those who wait find that it was done for all
            # before the look: what changes while the disk is written is written next
            self._changed.clear()
            now = self._others | {
                name: latch for name, each in self._trackers.items() if (latch := _latch_of(each.status))
            }
            if now == self._on_disk:
                return True
            self._on_disk = None
            try:
                await files.keep_latches(now)
            except OSError:
                return False  # the files have noted why
            self._on_disk = now
            return True


def _in_words(latch: KeptLatch) -> str:
    """Return what is known of a latch that an earlier daemon has kept."""
    at = None if latch.since is None else datetime.fromtimestamp(latch.since / 1e9, UTC)
    since = f" since {at.isoformat(timespec='milliseconds')}" if at else ""
    known = "its drive had confirmed it" if latch.confirmed else "its drive is not known to have confirmed it"
    return f"a stop is latched{since}, from an earlier run of the daemon: {known}"


def _latch_of(status: AxisStatus) -> KeptLatch | None:
    """Return what is to be kept of an axis; None while nothing forbids it to move."""
    stop, by = status.stop, status.latched_by
    again = stop.mode if stop and status.stop_due else None
    in_error, first = status.state is AxisState.ERROR_STOP, status.first_fault
    if not (status.stop_latched or again or in_error):
        return None
    return KeptLatch(
        stopped=status.stop_latched,
        again=again,
        confirmed=stop is None or (stop.unread and stop.fault is None),
        since=by.t if by else None,
        client=by.client if by else None,
        login=by.login if by else None,
        in_error=in_error,
        first_fault=first.past if first and in_error else None,
    )
