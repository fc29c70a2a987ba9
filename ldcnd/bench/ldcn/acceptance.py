"""Trying real drives: a bounded sequence that says for each assumption of the documents whether this drive confirms it.

It reads, and changes nothing, unless a move is requested; then one drive makes one short move and back, for as long as
the operator holds the dead-man. The exchanges are kept as a capture that can be replayed to the same sequence.
"""

import asyncio
from collections.abc import AsyncGenerator, Awaitable, Callable, Coroutine
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from ldcnd.bench.family import TrialMove
from ldcnd.bench.ldcn.examination import Held
from ldcnd.contract.errors import BusError, LdcndError, OutcomeUnknown, PacketRejected, ReplyTimeout
from ldcnd.contract.health import Finding, Verdict
from ldcnd.drives.driver import AxisSpec, CountsMotion, StopMode
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node, unanswered
from ldcnd.drives.ldcn.group_plan import EVERYBODY
from ldcnd.drives.ldcn.identity import ANY_DIALECT, UNADDRESSED, Identity, read_identity
from ldcnd.drives.ldcn.line_rate import NULLS_SETTLE_S, LineRate, nulls, once
from ldcnd.drives.ldcn.packet import StatusFlag, StatusItem, StatusPacket
from ldcnd.drives.ldcn.profiles import Profile, Support
from ldcnd.drives.ldcn.registers import RESET_BAUD, SERVO_CYCLE_S, BaudCodes
from ldcnd.drives.ldcn.servo import LdcnAxis
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import PacketEffect
from ldcnd.line.settings import BusSettings
from ldcnd.line.transport import Opener

MARGIN_S = 0.05
"""Margin for an adapter that is not examined yet: it may keep replies back for 16 ms."""
EXCHANGES = 100
READINGS = 20
MOST_ADDRESS = 32
UNUSED_ADDRESS = 127
"""An address that the daisy chain never gives."""
MOST_COUNTS = 100_000
LONGEST_MOVE_S = 10.0
CHECK_PERIOD_S = 0.02
STILL_COUNTS = 2
"""Maximum deviation of a servo that holds, counts."""
EVERYTHING = StatusItem(0xFF)
ResultT = TypeVar("ResultT")
MOTION = StatusItem.POSITION | StatusItem.VELOCITY | StatusItem.AUX


@dataclass(frozen=True, slots=True)
class LdcnAssumption:
    """An open or stated point of the documents on LDCN and NMC drives, and what would confirm it.

    Attributes:
        key: for reports.
        says: what ldcnd relies on.
        source: where that is from.
        confirmed_by: what is observed.
    """

    key: str
    says: str
    source: str
    confirmed_by: str


ASSUMPTIONS = (
    LdcnAssumption(
        "identity",
        "device id and version choose the dialect",
        "LS-182AP, Define Status; PIC-SERVO 5.2",
        "a pair that the table of dialects has",
    ),
    LdcnAssumption(
        "response_time",
        "a reply begins within a servo cycle (0.51 ms) after the request",
        "PIC-SERVO 3; LS-182AP, Serial command interface",
        f"{EXCHANGES} replies, the adapter's delay taken off",
    ),
    LdcnAssumption(
        "status_layout",
        "the dialect gives the length of a status packet",
        "LS-182AP, Define Status; PIC-SERVO 5.2",
        "a whole reply to all items, its checksum right",
    ),
    LdcnAssumption(
        "checksum",
        "a packet with a wrong checksum is answered with CHECKSUM_ERROR and not executed",
        "LS-182AP, Status byte; PIC-SERVO 5.3",
        "a Read Status with a wrong checksum",
    ),
    LdcnAssumption(
        "nulls",
        "16 nulls draw no reply and end a packet that was received in part",
        "PIC-SERVO 4.1",
        "half a packet, nulls, and an identity that is read at the first attempt",
    ),
    LdcnAssumption("silence", "an address that no drive has draws no reply", "PIC-SERVO 4.1", "address 127 is probed"),
    LdcnAssumption(
        "rest",
        "a drive at rest says so: velocity 0, a position that stays",
        "LS-182AP, Status byte; PIC-SERVO 5.3",
        f"{READINGS} readings",
    ),
    LdcnAssumption(
        "loop", "SERVO_ON tells whether the loop is closed", "PIC-SERVO 5.3", "it is set after power on (moving)"
    ),
    LdcnAssumption(
        "forward",
        "velocity and position have the sign of the dialect: forward is positive",
        "LS-182AP, Define Status",
        "both rise while the drive moves to a larger position (moving)",
    ),
    LdcnAssumption(
        "move_done",
        "MOVE_DONE is clear while a trapezoid runs and set at its end",
        "LS-182AP, Status byte; PIC-SERVO 5.3",
        "it is seen clear, then set at the target (moving)",
    ),
    LdcnAssumption(
        "smooth_stop",
        "Stop Motor with bit 3 decelerates and holds",
        "PIC-SERVO 5.2",
        "the way back is stopped (moving)",
    ),
)


Part = Callable[[], Awaitable[Finding]]
"""One thing that is tried, named for the assumption that it verifies."""


class DeadManReleased(LdcndError):
    """The dead-man is not held any more."""


def trial_bus(opener: Opener) -> Bus:
    """Return a bus for drives of which nothing is known yet."""
    return Bus(BusSettings("accept", RESET_BAUD, margin_s=MARGIN_S), opener)


async def accept(
    bus: Bus, move: TrialMove | None = None, held: Callable[[], bool] = lambda: False
) -> AsyncGenerator[Finding]:
    """Try every drive on an open line; yields each finding as it comes.

    Args:
        bus: of `trial_bus`, run by the caller.
        move: what may move; nothing does without.
        held: returns whether the dead-man is held; called all the time while something moves.
    """
    line = _Line(bus)
    found = await line.find()
    if not found:
        yield await line.silence()
        return
    for address, identity in found.items():
        drive = _Drive(bus, address, identity)
        for part in (drive.identity, drive.response_time, drive.status_layout, drive.checksum, drive.rest):
            yield await _tried(part, address)
    first = _Drive(bus, next(iter(found)), next(iter(found.values())))
    for part in (first.nulls, first.silence):
        yield await _tried(part, first.address)
    if move:
        async for finding in _moved(bus, found, move, held):
            yield finding


class _Line:
    """Finds drives that have addresses, by reading only."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._rate = LineRate(bus, RESET_BAUD, BaudCodes.MANUAL, (EVERYBODY,), fastest=True)

    async def find(self) -> dict[int, Identity]:
        """Return who is where, at the rate at which the first of them answers; the host stays there."""
        for baud in reversed(self._rate.candidates):
            if not await self._rate.host_to(baud):
                continue
            found: dict[int, Identity] = {}
            for address in range(1, MOST_ADDRESS + 1):
                identity = await self._rate.who_is(address, patient=bool(found))
                if identity:
                    found[address] = identity
                elif address > len(found) + 2:
                    break  # addresses follow one another; two that do not answer may be broken
            if found:
                return found
        await self._rate.host_to(RESET_BAUD)
        return {}

    async def silence(self) -> Finding:
        """Say why nothing can be tried."""
        try:
            await self._bus.execute(once(read_identity(UNADDRESSED.address)))
        except LdcndError:
            return Finding(axis="line", what="drives", verdict=Verdict.WRONG, text="no drive answers at any rate")
        text = "the first drive answers and has no address yet: start a daemon once, which gives addresses, and end it"
        return Finding(axis="line", what="drives", verdict=Verdict.WRONG, text=text)


class _Drive:
    """The trials of one drive; each part is named for the assumption that it verifies."""

    def __init__(self, bus: Bus, address: int, identity: Identity) -> None:
        self.address = address
        self._bus = bus
        self._known = identity
        self._profile: Profile | None = identity.profile
        self._node = Node(address, identity.profile or ANY_DIALECT)

    def _finding(self, key: str, text: str, *, confirmed: bool) -> Finding:
        verdict = Verdict.FINE if confirmed else Verdict.LOOK
        return Finding(axis=str(self.address), what=key, verdict=verdict, text=text, verifies=key)

    async def identity(self) -> Finding:
        """See `ASSUMPTIONS`, identity."""
        pair = f"id {self._known.device_id}, version {self._known.version}"
        return self._finding("identity", f"{self._known} ({pair})", confirmed=self._profile is not None)

    async def response_time(self) -> Finding:
        """See `ASSUMPTIONS`."""
        from_s = asyncio.get_running_loop().time()
        for number in range(EXCHANGES):
            await asyncio.sleep(SERVO_CYCLE_S * number / EXCHANGES)
            await self._bus.execute(commands.no_operation(self._node))
        records = [record for record in self._bus.wire_log.records() if record.at_s >= from_s]
        held = Held.of(records, self._bus.settings.bits_per_byte / self._bus.baud)
        shortest_s, longest_s = held.times_s[0], held.longest_s
        spread_s = longest_s - shortest_s
        text = (
            f"replies began {1000 * shortest_s:.2f} to {1000 * longest_s:.2f} ms after the request, adapter and host"
            f" included; the drive's share is {1000 * spread_s:.2f} ms at most"
        )
        return self._finding("response_time", text, confirmed=spread_s <= SERVO_CYCLE_S + 0.001)

    async def status_layout(self) -> Finding:
        """See `ASSUMPTIONS`."""
        exchange = commands.read_status(self._node, EVERYTHING if self._profile else StatusItem.IDENTITY)
        status = await self._bus.execute(exchange)
        text = f"{exchange.reply_bytes} bytes to all items: {_words(status)}"
        return self._finding("status_layout", text, confirmed=self._profile is not None)

    async def checksum(self) -> Finding:
        """See `ASSUMPTIONS`."""
        exchange = commands.no_operation(self._node)
        spoilt = exchange.request[:-1] + bytes([exchange.request[-1] ^ 0x55])
        try:
            await self._bus.execute(replace(exchange, request=spoilt))
        except PacketRejected:
            return self._finding("checksum", "refused with CHECKSUM_ERROR", confirmed=True)
        except (ReplyTimeout, OutcomeUnknown):
            return self._finding("checksum", "a packet with a wrong checksum is not answered at all", confirmed=False)
        return self._finding(
            "checksum", "a packet with a wrong checksum is answered as if it were right", confirmed=False
        )

    async def rest(self) -> Finding:
        """See `ASSUMPTIONS`."""
        readings = []
        for _ in range(READINGS):
            readings.append(await self._bus.execute(commands.read_status(self._node, MOTION)))
            await asyncio.sleep(CHECK_PERIOD_S)
        positions = [reading.position or 0 for reading in readings]
        fast = max(abs(reading.velocity or 0) for reading in readings)
        seen = f"positions {min(positions)} to {max(positions)}, velocity up to {fast} counts a tick"
        text = f"{seen}; {_words(readings[-1])}"
        return self._finding("rest", text, confirmed=max(positions) - min(positions) <= STILL_COUNTS and fast == 0)

    async def nulls(self) -> Finding:
        """See `ASSUMPTIONS`."""
        half = commands.no_operation(self._node).request[:2]
        await self._bus.execute(
            unanswered(EVERYBODY, half, NULLS_SETTLE_S, repeatable=False, effect=PacketEffect.READS)
        )
        await self._bus.execute(nulls(NULLS_SETTLE_S))
        await self._bus.execute(once(read_identity(self.address, self._known)))
        return self._finding(
            "nulls", "no reply to half a packet and 16 nulls; the next packet was answered", confirmed=True
        )

    async def silence(self) -> Finding:
        """See `ASSUMPTIONS`."""
        try:
            await self._bus.execute(once(read_identity(UNUSED_ADDRESS)))
        except (ReplyTimeout, OutcomeUnknown):
            return self._finding("silence", f"no drive answered at address {UNUSED_ADDRESS}", confirmed=True)
        return self._finding("silence", f"a drive answers at address {UNUSED_ADDRESS}", confirmed=False)


# -- moving ----------------------------------------------------------------------------------------------------------


async def _moved(
    bus: Bus, found: dict[int, Identity], move: TrialMove, held: Callable[[], bool]
) -> AsyncGenerator[Finding]:
    """Let one drive make its move and a part of the way back; the loop is open again at the end, however it ends.

    Nothing is told before that: whoever prints it may be held up, or may not come back.
    """
    identity = found.get(move.address)
    profile = identity.profile if identity else None
    if profile is None or profile.support is not Support.FULL or not 0 < abs(move.counts) <= MOST_COUNTS:
        text = f"address {move.address} is no drive that may move, or {move.counts} counts are not 1 to {MOST_COUNTS}"
        yield Finding(axis=str(move.address), what="move", verdict=Verdict.WRONG, text=text)
        return
    bus.proofs.expect(move.address, f"address {move.address}").prove()
    axis = LdcnAxis(AxisSpec("trial", move.address, profile.name, move.gains), profile, bus)
    trial = _Trial(bus, axis, Node(move.address, profile), move, held)
    findings: list[Finding] = []
    try:
        for part in (trial.loop, trial.there, trial.stopped_on_the_way_back):
            findings += await part()
    except LdcndError as error:
        findings.append(trial.finding("move", f"ended: {error.message}", confirmed=False))
    finally:
        is_off = await _to_its_end(trial.off())
    if not is_off:
        text = "it has NOT confirmed that its motor is off: use the machine's emergency stop"
        yield Finding(axis=str(move.address), what="off", verdict=Verdict.WRONG, text=text)
    for finding in findings:
        yield finding


class _Trial:
    """One drive's trial move; every wait checks the dead-man."""

    def __init__(self, bus: Bus, axis: LdcnAxis, node: Node, move: TrialMove, held: Callable[[], bool]) -> None:
        self._bus = bus
        self._axis = axis
        self._node = node
        self._move = move
        self._held = held
        self._origin = 0
        self._holds = False  # its loop was seen closed last

    def finding(self, key: str, text: str, *, confirmed: bool) -> Finding:
        """Return a finding about this drive."""
        verdict = Verdict.FINE if confirmed else Verdict.LOOK
        return Finding(axis=str(self._move.address), what=key, verdict=verdict, text=text, verifies=key)

    async def off(self) -> bool:
        """Stop, and open the loop, each sent three times at most; tell whether the drive has acknowledged the latter.

        Only a closed loop is stopped first: an open one would be closed by that (PIC-SERVO manual, 5.2, "Stop Motor").
        """
        is_off = False
        for mode in (StopMode.SMOOTH, StopMode.OFF) if self._holds else (StopMode.OFF,):
            for _ in range(3):
                try:
                    await self._axis.stop(mode)
                except BusError:
                    continue
                is_off = mode is StopMode.OFF
                break
        return is_off

    async def loop(self) -> tuple[Finding, ...]:
        """Close the loop where the motor is."""
        self._require_held()
        await self._axis.power(on=True)
        status = await self._look()
        self._origin = status.position or 0
        said = "set" if self._holds else "clear"
        return (self.finding("loop", f"SERVO_ON is {said} after power on", confirmed=self._holds),)

    async def there(self) -> tuple[Finding, ...]:
        """Move to the target."""
        seen = await self._run_to(self._origin + self._move.counts, until=self._done)
        ahead = 1 if self._move.counts > 0 else -1
        running = [status for status in seen if not self._done(status)]
        rose = ahead * ((seen[-1].position or 0) - self._origin) > 0
        fast = [ahead * (status.velocity or 0) for status in running]
        signs = rose and bool(fast) and max(fast) > 0 and min(fast) >= -1
        off_by = (seen[-1].position or 0) - self._origin - self._move.counts
        speeds = f"{min(fast, default=0)} to {max(fast, default=0)}"
        text = f"{len(running)} readings on the way, velocity {speeds} counts a tick"
        done = bool(running) and self._done(seen[-1]) and abs(off_by) <= max(10, abs(self._move.counts) // 100)
        return (
            self.finding("forward", text, confirmed=signs),
            self.finding("move_done", f"set at the end, {off_by} counts off the target", confirmed=done),
        )

    async def stopped_on_the_way_back(self) -> tuple[Finding, ...]:
        """Begin to move back, and stop smoothly."""
        half_s = 0.5 * abs(self._move.counts) / self._move.velocity_counts_per_s
        ends_s = asyncio.get_running_loop().time() + half_s
        await self._run_to(self._origin, until=lambda _status: asyncio.get_running_loop().time() >= ends_s)
        await self._axis.stop(StopMode.SMOOTH)
        readings = await self._settled()
        positions = [reading.position or 0 for reading in readings]
        still = abs(positions[-1] - positions[-2]) <= STILL_COUNTS
        text = f"stopped at {positions[-1] - self._origin} counts from where it began"
        return (self.finding("smooth_stop", text, confirmed=still),)

    async def _run_to(self, target: int, until: Callable[[StatusPacket], bool]) -> list[StatusPacket]:
        """Move until the condition is met, and return what was seen.

        Raises:
            DeadManReleased: the drive is stopped by the caller.
        """
        self._require_held()
        velocity, acceleration = self._move.velocity_counts_per_s, self._move.acceleration_counts_per_s2
        await self._axis.load(CountsMotion(target, velocity, acceleration))
        self._require_held()
        await self._axis.start()
        loop = asyncio.get_running_loop()
        ends_s = loop.time() + LONGEST_MOVE_S
        seen = []
        while loop.time() < ends_s:
            self._require_held()
            seen.append(await self._look())
            if until(seen[-1]):
                return seen
            await asyncio.sleep(CHECK_PERIOD_S)
        raise LdcndError(f"the move took longer than {LONGEST_MOVE_S:g} s")

    async def _settled(self) -> list[StatusPacket]:
        seen = []
        for _ in range(READINGS):
            self._require_held()
            seen.append(await self._look())
            await asyncio.sleep(CHECK_PERIOD_S)
        return seen

    async def _look(self) -> StatusPacket:
        status = await self._bus.execute(commands.read_status(self._node, MOTION))
        self._holds = bool(status.aux and status.aux.SERVO_ON in status.aux)
        return status

    def _done(self, status: StatusPacket) -> bool:
        return bool(status.flags & StatusFlag.MOVE_DONE)

    def _require_held(self) -> None:
        if not self._held():
            raise DeadManReleased("the dead-man was released")


async def _to_its_end(work: Coroutine[Any, Any, ResultT]) -> ResultT:
    """Return what a work returns that no cancel breaks off: whoever is impatient presses Ctrl-C again."""
    task, cancelled = asyncio.ensure_future(work), False
    while not task.done():
        try:
            await asyncio.shield(task)
        except asyncio.CancelledError:
            cancelled = True
    if cancelled:
        raise asyncio.CancelledError
    return task.result()


async def _tried(part: Part, address: int) -> Finding:
    """Return what a part finds; that the line refuses it is a finding, too."""
    try:
        return await part()
    except LdcndError as error:
        name = getattr(part, "__name__", "part")
        return Finding(axis=str(address), what=name, verdict=Verdict.WRONG, text=error.message, verifies=name)


def _words(status: StatusPacket) -> str:
    flags = [flag.name or "" for flag in StatusFlag if flag in status.flags]
    return f"status {int(status.flags):02X} ({', '.join(flags)})"
