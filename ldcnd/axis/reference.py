"""The reference of one axis beyond the life of its daemon: kept while it is known, believed again only with proof.

A drive counts on while no daemon watches. What has to be proven is that its counter was not set to another number
meanwhile. So together with the reference the daemon keeps what the drive has in a register that a reset clears and a
capture overwrites - the mark -, its identity and rate, whether its loop was closed, and where it was. Everything has to
be the same afterwards; anything else refuses the reference. A drive that was pushed or moved by another program is
elsewhere, and is refused as well.
"""

import asyncio
import contextlib

from ldcnd.axis.clock import Clock
from ldcnd.axis.kept import FORMAT, KeptFiles, KeptReference, ReferenceEvidence, in_words
from ldcnd.axis.rest import window_counts
from ldcnd.axis.status import AxisStatus, new_faults
from ldcnd.axis.tracker import AxisTracker
from ldcnd.contract.errors import CommandAborted, LdcndError, WrongState
from ldcnd.contract.samples import AxisState, PastFault
from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.driver import Drive, Evidence, Moves
from ldcnd.line.proof import only_while
from ldcnd.log import get_logger

LEAST_MARK = 100
"""A mark nearer to 0 could be a coincidence: a reset leaves 0."""
NEAR_COUNTS = 32
"""Largest displacement of an axis at rest besides its settle window, counts: loops hunt, shafts relax."""
UNWRITTEN = "what the earlier daemon wrote since did not get onto the disk, see `not kept on disk` in its log"
AS_AFTER_RESET = 2
"""Largest count, either side of 0, of a counter that may have been reset."""
REST_S = 0.5
"""Delay between the rest of an axis and the writing of its reference, seconds."""
CHECK_S = 10.0
"""Longest time until the position of a shaft turned by hand, or a mark lost to a capture, is written, seconds."""
READINGS = 3
"""A proof that fails is read again: one reading may be falsified by noise."""
FAULTS_KEPT = 50
END_TIME_S = 1.0
"""Longest delay of the daemon's end for this, seconds."""
STOPPING_S = 0.05
"""Longest time between two readings of an axis that comes to rest at the end of the daemon, seconds."""
log = get_logger("axis")


def contradiction(kept: KeptReference, shown: Evidence, near_counts: float, *, unwritten: bool = False) -> str:
    """Return in words the value of a drive that contradicts a reference; empty when none does.

    Args:
        kept: the reference.
        shown: what the drive shows now.
        near_counts: how far it may be from where it was.
        unwritten: something later could not be written: what differs may be the daemon's own doing.
    """
    since = UNWRITTEN if unwritten else ""
    if shown.mark != kept.mark:
        since = since or "it was reset, another program has used it, or this reference could not be removed"
        return f"its mark is {shown.mark} and was {kept.mark}: {since}"
    if abs(shown.counter) <= AS_AFTER_RESET:
        return f"its counter reads {shown.counter}, as after a reset"
    if shown.position_lost:
        return "it may have missed counts"
    if shown.enabled is not kept.enabled:
        now, was = ("closed", "open") if shown.enabled else ("open", "closed")
        since = since or "a fault, another program or a daemon that could not keep that has switched it"
        return f"its loop is {now} and was {was}: {since}"
    if not kept.low - near_counts <= shown.counter <= kept.high + near_counts:
        off = shown.counter - (kept.high if shown.counter > kept.high else kept.low)
        since = since or "it was moved while no daemon watched it, or could keep that"
        return f"it is {off} counts from where it was left: {since}"
    return ""


class ReferenceKeeper:
    """Keeps the reference and the faults of one axis.

    Attributes:
        faults: those that the axis has had, oldest first.
        woken: to be set when something has changed: a motion, the power, the reference, a fault.
    """

    def __init__(
        self,
        config: AxisConfig,
        drive: Drive,
        tracker: AxisTracker,
        clock: Clock,
        files: KeptFiles | None,
        *,
        references: bool,
    ) -> None:
        """Take what an axis consists of.

        Args:
            config: of the axis.
            drive: its drive.
            tracker: of its state.
            clock: of the daemon.
            files: where things are kept; None where nothing is.
            references: references are kept, too.
        """
        self.faults: tuple[PastFault, ...] = ()
        self._config = config
        self._drive = drive if references and isinstance(drive, Moves) and drive.keeps_mark else None
        self._tracker = tracker
        self._clock = clock
        self._files = files
        self._kept: KeptReference | None = None  # as it is on the disk
        self._on_disk = False  # something may be there
        self._unwritten = False  # an earlier daemon could not write what came later
        self._proof: ReferenceEvidence | None = None
        self._generation = 0  # of origins: what was read under an earlier one is not written
        self._faults_kept = 0
        self.woken = asyncio.Event()
        self._closed = False
        tracker.watch(self._watch, "faults")
        if self._drive and files:
            self._drive.about_to_renumber = self.forget

    # -- before anything changes -------------------------------------------------------------------------------------

    async def forget(self) -> None:
        """Remove the reference from the disk, because the axis is about to get another one.

        Where that is not possible the drive gets another mark, with which no reference on the disk agrees.

        Raises:
            WrongState: neither is possible; a restart would accept it.
        """
        self._generation += 1
        if self._files is None or self._drive is None or not self._on_disk:
            return
        try:
            await self._files.remove_reference(self._config.name)
        except OSError as error:
            if await self._is_void_without(self._drive):
                self._kept = None
                return
            raise WrongState(
                f"axis {self._config.name}: the reference that is kept cannot be removed: {in_words(error)}; the next"
                " start of the daemon would believe it",
                axis=self._config.name,
                remedy="make state_dir writable, or remove the file below it",
            ) from error
        self._kept, self._on_disk = None, False

    async def void_elsewhere(self) -> None:
        """Give the drive another mark, because the axis is about to get another place where it stands.

        A daemon that had another folder, or another name for the axis, may have kept a reference that agrees with the
        mark that the drive has. Where the axis stands on that mark to the count there is no other one to give.
        """
        if self._drive:
            await self._is_void_without(self._drive)

    async def _is_void_without(self, drive: Moves) -> bool:
        """Make the drive disagree with whatever reference is on the disk; tell whether it does."""
        try:
            before = await drive.evidence()
            if abs(before.mark) < LEAST_MARK:
                return True  # no reference has such a mark
            # a new mark would be the old one: it is the place where the axis stands
            if before.counter == before.mark:
                return False
            await drive.leave_mark()
            return (await drive.evidence()).mark != before.mark
        except LdcndError:
            return False

    # -- at the start ------------------------------------------------------------------------------------------------

    async def _recall_faults(self, files: KeptFiles) -> None:
        """Read the faults that an earlier daemon has kept."""
        try:
            kept = await files.faults(self._config.name)
        except (OSError, ValueError) as error:
            log.warning("kept faults not read", axis=self._config.name, reason=in_words(error))
            return
        if not self.faults:
            self._faults_kept = len(kept)
        self.faults = (*kept, *self.faults)

    @property
    def stood(self) -> bool:
        """Whether the shaft stood when the reference was kept that holds still."""
        return self._kept is not None and self._kept.low == self._kept.high

    async def recall(self, baud: int, identity: str, interrupted: str) -> tuple[float | None, str]:
        """Decide whether the reference that an earlier daemon has kept still holds.

        Args:
            baud: rate of the line.
            identity: what the drive says it is.
            interrupted: what is known to have reset the drive; empty when nothing is.

        Returns:
            The origin in counts, None when there is none, and why a reference was refused.
        """
        if self._files is None or self._drive is None:
            return None, ""
        self._proof = ReferenceEvidence(
            address=self._config.address, identity=identity, baud=baud, scale=_scale_of(self._config)
        )
        # until it is known that there is none: one that cannot be read is there, too
        self._on_disk = True
        try:
            kept = await self._files.reference(self._config.name)
        except (OSError, ValueError) as error:
            return None, f"it cannot be read: {in_words(error)}"
        self._unwritten = await self._files.is_unwritten(self._config.name)
        if kept is None:
            self._on_disk = self._unwritten
            return None, UNWRITTEN if self._unwritten else ""
        refusal = interrupted or self._proof.differs(kept)
        if not refusal:
            refusal, shown = await self._examined(self._drive, kept)
            if shown and not refusal:
                self._kept = kept
                return kept.origin + shown.counts - shown.counter, ""
        return None, refusal

    async def _examined(self, drive: Moves, kept: KeptReference) -> tuple[str, Evidence | None]:
        refusal, shown = "", None
        for _ in range(READINGS):
            try:
                shown = await drive.evidence()
            except LdcndError as error:
                refusal = f"the drive could not be read: {error.message}"
                continue
            refusal = contradiction(kept, shown, self._near_counts, unwritten=self._unwritten)
            if not refusal:
                return "", shown
        return refusal, shown

    # -- while it runs -----------------------------------------------------------------------------------------------

    async def run(self) -> None:
        """Keep what is known on the disk until cancelled."""
        if self._files is None:
            return
        await self._recall_faults(self._files)
        while not self._closed:
            await self._woken_within(CHECK_S)
            self.woken.clear()
            if self._moves:
                await self._keep_motion()
            else:
                await self._woken_within(REST_S)
                # something has changed again: it does not rest for long enough yet
                if self.woken.is_set():
                    continue
                await self._keep()
            await self._keep_faults()

    async def finish(self) -> None:
        """Keep what holds at the end of the daemon, while the line is still up."""
        self._closed = True
        if self._files is None:
            return
        try:
            async with asyncio.timeout(END_TIME_S):
                while self._tracker.status.state is AxisState.STOPPING:
                    self.woken.clear()
                    await self._woken_within(STOPPING_S)
                if not self._moves:
                    await self._keep()
                await self._keep_faults()
        except TimeoutError:
            # what was kept of its motion says how far it may go
            log.warning("not at rest in time: kept as it moved", axis=self._config.name)

    async def _woken_within(self, pause_s: float) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(pause_s):
                await self.woken.wait()

    @property
    def _moves(self) -> bool:
        return self._tracker.status.command is not None or not self._tracker.status.at_rest

    @property
    def _near_counts(self) -> float:
        return NEAR_COUNTS + window_counts(self._config)

    async def _keep_motion(self) -> None:
        """Widen what is kept by where the motion under way ends, so that a crash in it costs no reference."""
        kept, command = self._kept, self._tracker.status.command
        if kept is None or command is None or command.settling is None or not self._tracker.status.referenced:
            return
        target = command.settling.target_counts - self._offset_counts(kept)
        low, high = min(kept.low, target), max(kept.high, target)
        if (low, high, True) != (kept.low, kept.high, kept.enabled):
            await self._write(kept.model_copy(update={"low": low, "high": high, "enabled": True}), self._generation)

    def _offset_counts(self, kept: KeptReference) -> int:
        """Return what the daemon's counts are ahead of the drive's counter."""
        return round(self._tracker.status.scale.origin_counts - kept.origin)

    async def _keep(self) -> None:
        """Keep where an axis stands, with what its drive shows there."""
        if self._files is None or self._drive is None or self._proof is None:
            return
        tracker, generation = self._tracker, self._generation
        if not tracker.status.referenced:
            await self._give_up()
            return
        try:
            shown = await self._drive.evidence()
            if abs(shown.mark) < LEAST_MARK <= abs(shown.counter) and self._stands_referenced():
                with only_while(self._check_stands):  # a capture that comes before its turn would be overwritten
                    await self._drive.leave_mark()
                shown = await self._drive.evidence()
        except LdcndError as error:
            log.debug("reference not kept", axis=self._config.name, reason=error.message)
            return
        # it may have been moved, or have lost its place, while the drive was read
        if not self._stands_referenced() or shown.position_lost:
            return
        if abs(shown.mark) < LEAST_MARK:
            await self._give_up()  # nothing of it would show a reset
            return
        low = high = shown.counter
        kept = self._kept
        if kept and kept.low == kept.high and abs(kept.low - shown.counter) <= AS_AFTER_RESET:
            # a count or two of hunting are not worth a write
            low, high = kept.low, kept.high
        reference = KeptReference(
            format=FORMAT,
            written=self._clock.now_ns(),
            **dict(self._proof),
            origin=self._tracker.status.scale.origin_counts - (shown.counts - shown.counter),
            mark=shown.mark,
            enabled=shown.enabled,
            low=low,
            high=high,
        )
        if kept is None or reference != kept.model_copy(update={"written": reference.written}):
            await self._write(reference, generation)

    def _check_stands(self) -> None:
        if not self._stands_referenced():
            raise CommandAborted(f"axis {self._config.name} moves, or is no longer referenced", axis=self._config.name)

    def _stands_referenced(self) -> bool:
        return not self._moves and self._tracker.status.referenced

    async def _write(self, reference: KeptReference, generation: int) -> None:
        if self._files is None or generation != self._generation:
            return  # read under another origin
        # before the disk has it: who forgets meanwhile is to remove it behind this, also what a failure leaves there
        self._on_disk = True
        try:
            await self._files.keep_reference(self._config.name, reference)
        except OSError:
            return
        if generation == self._generation:
            self._kept = reference

    async def _give_up(self) -> None:
        """The axis has no reference any more, or none that could be proven: nor may the disk say so."""
        if not self._on_disk:
            return
        with contextlib.suppress(WrongState):  # the files have logged why
            await self.forget()

    async def _keep_faults(self) -> None:
        if self._files is None or self._faults_kept == len(self.faults):
            return
        faults = self.faults = self.faults[-FAULTS_KEPT:]
        with contextlib.suppress(OSError):  # likewise
            await self._files.keep_faults(self._config.name, faults)
        # also if it failed: the next fault tries again
        self._faults_kept = len(faults)

    def _watch(self, before: AxisStatus, after: AxisStatus) -> None:
        for entry in new_faults(before, after):
            self.faults = (*self.faults, entry.past)
            self._faults_kept = -1
            self.woken.set()


def _scale_of(config: AxisConfig) -> tuple[float, str, float | None]:
    return (config.signed_counts_per_unit, config.unit, config.modulo)
