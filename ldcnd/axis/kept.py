"""Data of axes on disk: reference, with the values that prove it, and past faults, one file each; and all latches.

What forbids axes to move is in one file, because one stop may concern them all.

A reference is removed from the disk before anything may change it, and written again afterwards: a crash in between
costs the reference, and a file never says more than was true when it was written.
"""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal, TypeVar

from pydantic import Field

from ldcnd import durable
from ldcnd.contract.frozen import Frozen
from ldcnd.contract.samples import PastFault
from ldcnd.drives.driver import StopMode
from ldcnd.durable import DamagedFile
from ldcnd.log import get_logger
from ldcnd.own_thread import OwnThread

log = get_logger("kept")
FORMAT = 1
NS = 10**9
LATCHES = "latches.json"
LATCH_ROOM_BYTES = 16 * 1024
"""Kept on the disk for latches that come once it is full: more than 30 axes in error_stop take."""
ResultT = TypeVar("ResultT")


class ReferenceEvidence(Frozen):
    """Properties of an axis that must not have changed, besides the values of its drive."""

    address: int
    """Address of the drive on its line."""
    identity: str
    """Identity that the drive reports."""
    baud: int
    """Rate of the line: a drive that was reset is at another one."""
    scale: tuple[float, str, float | None]
    """Counts per unit, negative in reverse; unit; modulo."""

    def differs(self, kept: "KeptReference") -> str:
        """Return the difference in words; empty without one."""
        if kept.format != FORMAT:
            return f"it was kept by another version of the daemon (format {kept.format}, not {FORMAT})"
        for name, was, now in (
            ("address", kept.address, self.address),
            ("identity of the drive", kept.identity, self.identity),
            ("rate of the line", kept.baud, self.baud),
            ("scale, unit or modulo", kept.scale, self.scale),
        ):
            if was != now:
                return f"{name} was {was} and is {now}"
        return ""


class KeptReference(ReferenceEvidence):
    """Position 0 on the counter of a drive, and the conditions under which it is valid."""

    format: int
    """Format of this file; another one is refused."""
    written: int
    """Time of writing, UTC in ns since 1970."""
    on_disk: int = 0
    """The same instant by the clock of files: see `_check_left_there`."""
    origin: float
    """Position 0 on the drive's own counter."""
    mark: int
    """Value of the drive's mark register; a reset clears it."""
    enabled: bool
    """The position loop was closed."""
    low: int
    """Lower bound of the drive's counter,"""
    high: int
    """and its upper bound: both are the position at rest, or a motion under way lies between them."""


class FaultFile(Frozen):
    """The faults of one axis."""

    faults: tuple[PastFault, ...]
    """Oldest first."""


class KeptLatch(Frozen):
    """What forbids an axis to move until it is reset."""

    stopped: bool = False
    """A stop is latched."""
    again: StopMode | None = None
    """How it is to be stopped, because its drive has not confirmed that, or was not read since."""
    confirmed: bool = False
    """No stop was asked for in vain; false in a file of an earlier version, which does not say."""
    since: int | None = None
    """When the stop was latched, UTC in ns since 1970; null where that is not known."""
    client: str | None = None
    """Who has latched it, as it calls itself."""
    login: str | None = None
    """Common name of the certificate of its link."""
    in_error: bool = False
    """It is in error_stop."""
    first_fault: PastFault | None = None
    """What brought it there."""


class LatchFile(Frozen):
    """The latches of the axes of one rig, by name; an axis that may move is not among them."""

    format: Literal[1] = 1
    """Format of this file; another one is refused."""
    on_disk: int | None = None
    """When it was written, UTC in ns since 1970, see `_check_left_there`; null in a file of an earlier version."""
    generation: int = Field(default=0, ge=0)
    """Higher than that of every file that was there before of the same drives, also of a daemon of one of their lines:
    a clock that was set does not tell which is the later one. 0 in a file of an earlier version."""
    axes: dict[str, KeptLatch]
    """By the names of the axes."""
    rig: str = ""
    """The whole rig, also where its daemon has one line of it; empty in a file of an earlier version, like `places`."""
    places: dict[str, str] = Field(default_factory=dict)
    """Which drive each axis was, latched or not: its line and address, by the name of the axis. Of a drive that is not
    among them it is not known whether it was stopped."""


class KeptFiles:
    """The files of one rig.

    One thread writes them, so that they change in the order of the requests; the latches have one of their own, because
    the answer of a stop waits for them.

    Attributes:
        troubles: why files are not on the disk as they should be, by their names.
        places: the line and address of each axis, by its name.
    """

    def __init__(self, directory: Path, rig: str, places: Mapping[str, str]) -> None:
        self.troubles: dict[str, str] = {}
        self.places = dict(places)
        lines = {place.partition("/")[0] for place in self.places.values()}
        # as `single_line` names the folder and the rig of a line that is served alone
        self._rig = rig.removesuffix(f"_{directory.name}") if lines == {directory.name} else rig
        self._directory = directory
        self._worker = OwnThread("kept files")
        self._latches = directory / LATCHES
        self._generation = 0
        self._latch_worker = OwnThread("kept latches")

    def latches(self) -> LatchFile | None:
        """Return the latches that are kept; None where there is no file of them, in a directory that is new.

        The caller waits for the disk, since nothing may move before.

        Raises:
            DamagedFile: they cannot be read, make no sense, were put there by another program, or are older than those
                that a daemon of one of the drives has left in a directory above or below.
        """
        self._latch_worker.submit(durable.keep_room, self._latches, LATCH_ROOM_BYTES)
        others = self._of_others()
        self._generation = max((each.generation for each in others.values()), default=0)
        kept = _read(self._latches, LatchFile)()
        if kept:
            self._generation = max(self._generation, kept.generation)
            if kept.on_disk is not None:
                _check_left_there(self._latches, kept.on_disk)
        for path, other in others.items():
            if _order(other) > (_order(kept) if kept else (0, 0)):
                raise DamagedFile(f"{path}: another daemon of these drives has written it since")
        return kept

    def _of_others(self) -> dict[Path, LatchFile]:
        """Return the words of daemons that had one line of the rig, or that line and all others, by their files."""
        found = dict[Path, LatchFile]()
        for path in (self._directory.absolute().parent / LATCHES, *self._directory.glob(f"*/{LATCHES}")):
            with suppress(DamagedFile):  # of whatever rig
                other = _read(path, LatchFile)()
                if other and other.rig == self._rig and other.places.items() & self.places.items():
                    found[path] = other
        return found

    async def keep_latches(self, latches: dict[str, KeptLatch]) -> None:
        """Write the latches of all axes; they are on the disk when this returns.

        Raises:
            OSError: they cannot be written; what was kept before still is.
        """

        def write() -> None:
            self._generation += 1
            now = LatchFile(
                generation=self._generation, axes=latches, on_disk=time.time_ns(), rig=self._rig, places=self.places
            )
            durable.replace(self._latches, now.model_dump_json(exclude_defaults=True))

        with self._noted(self._latches):
            await self._in_thread(write, self._latch_worker)
        # for the next one: this one has become the file, with the room that was kept
        self._latch_worker.submit(durable.keep_room, self._latches, LATCH_ROOM_BYTES)

    async def reference(self, axis: str) -> KeptReference | None:
        """Return the reference that is kept of an axis; None without one.

        Raises:
            TimeoutError: the disk takes too long.
            DamagedFile: it cannot be read, makes no sense, or was put there by another program.
        """
        path = self._path("references", axis)

        def read() -> KeptReference | None:
            kept = _read(path, KeptReference)()
            if kept:
                _check_left_there(path, kept.on_disk)
            return kept and kept.model_copy(update={"on_disk": 0})

        return await self._in_thread(read)

    async def keep_reference(self, axis: str, reference: KeptReference) -> None:
        """Write the reference of an axis; it is on the disk when this returns.

        Raises:
            OSError: it cannot be written; what was kept before still is.
        """
        path = self._path("references", axis)

        def write() -> None:
            now = reference.model_copy(update={"on_disk": time.time_ns()})
            try:
                durable.replace(path, now.model_dump_json())
            except OSError:
                durable.keep_room(path, 0)  # a full disk takes a draft without a text, by which the next start knows
                raise

        with self._noted(path):
            await self._in_thread(write)

    async def remove_reference(self, axis: str) -> None:
        """Remove the reference of an axis; it has gone from the disk when this returns.

        Raises:
            OSError: it cannot be removed.
        """
        path = self._path("references", axis)
        with self._noted(path):
            await self._in_thread(lambda: durable.remove(path))

    async def is_unwritten(self, axis: str) -> bool:
        """Tell whether the disk has not taken the latest reference of an axis."""
        path = self._path("references", axis)
        try:
            return await self._in_thread(lambda: durable.has_draft(path))
        except OSError:
            return False

    async def faults(self, axis: str) -> tuple[PastFault, ...]:
        """Return the faults that are kept of an axis, oldest first.

        Raises:
            TimeoutError: the disk takes too long.
            DamagedFile: they cannot be read, or make no sense.
        """
        kept = await self._in_thread(_read(self._path("faults", axis), FaultFile))
        return kept.faults if kept else ()

    async def keep_faults(self, axis: str, faults: tuple[PastFault, ...]) -> None:
        """Write the faults of an axis.

        Raises:
            OSError: they cannot be written.
        """
        path, text = self._path("faults", axis), FaultFile(faults=faults).model_dump_json()
        with self._noted(path):
            await self._in_thread(lambda: durable.replace(path, text))

    def _path(self, what: str, axis: str) -> Path:
        return self._directory / what / f"{axis}.json"

    @contextmanager
    def _noted(self, path: Path) -> Iterator[None]:
        """Note why a file cannot be written, until it can, and log each reason once."""
        name = str(path.relative_to(self._directory))
        try:
            yield
        except OSError as error:
            why = in_words(error)
            if self.troubles.get(name) != why:
                log.error("not kept on disk", file=name, reason=why)
            self.troubles[name] = why
            raise
        self.troubles.pop(name, None)

    async def _in_thread(self, work: Callable[[], ResultT], worker: OwnThread | None = None) -> ResultT:
        return await (worker or self._worker).run(work, durable.DISK_TIME_S)  # TimeoutError is an OSError


def in_words(error: Exception) -> str:
    """Return why a file could not be read or written."""
    if isinstance(error, TimeoutError):
        return "the disk does not answer"
    return getattr(error, "strerror", None) or str(error)


ModelT = TypeVar("ModelT", bound=Frozen)


def _check_left_there(path: Path, on_disk: int) -> None:
    """Refuse a file that another program has put there, such as one of a backup: what came since then is not in it.

    A file says when it was written; neither `cp` nor `tar` can set the time at which its inode has changed last.

    Raises:
        DamagedFile: it was put there at another time than it was written; a clock may have gone back in between.
    """
    if abs(path.stat().st_ctime_ns - on_disk) > durable.DISK_TIME_S * NS:
        raise DamagedFile(f"{path}: is a copy that was put there, and may be older than what it replaced")


def _order(kept: LatchFile) -> tuple[int, int]:
    """Return what is higher of the later one of two files; of files of an earlier version their instant tells."""
    return kept.generation, 0 if kept.generation else kept.on_disk or 0


def _read(path: Path, model: type[ModelT]) -> Callable[[], ModelT | None]:
    return lambda: durable.read(path, model.model_validate_json)
