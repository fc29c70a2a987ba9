"""One LDCN/NMC line: from whatever state it is in to drives that can be polled, and back when some of them lose power.

Sources: LS-182AP manual, "Addressing", "Changing communications rates"; PIC-SERVO manual, 4.1 "Network initialization".
"""

import asyncio
import contextlib
from collections.abc import Callable, Mapping
from collections.abc import Set as AbstractSet
from dataclasses import replace
from typing import Any

from typing_extensions import override

from ldcnd.contract.errors import BusError, LdcndError, NetworkMismatch
from ldcnd.contract.meta import ModuleInfo
from ldcnd.drives.driver import AxisSpec, CountsMotion, Drive, StopMode
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.addressing import Addressing
from ldcnd.drives.ldcn.adoption import STILL_COUNTS, UNADDRESSED, Adopted, Adoption, Found
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.config import LineSpec
from ldcnd.drives.ldcn.faults import servo_on
from ldcnd.drives.ldcn.gathering import Gathering
from ldcnd.drives.ldcn.group_plan import EVERYBODY, GroupPlan
from ldcnd.drives.ldcn.groups import TAKEN_OVER, Groups
from ldcnd.drives.ldcn.identity import ANY_DIALECT, Expected, Identity, differences, read_identity
from ldcnd.drives.ldcn.io_module import IoModule
from ldcnd.drives.ldcn.line_rate import NULLS, NULLS_SETTLE_S, LineRate
from ldcnd.drives.ldcn.packet import STATUS_BYTE_ONLY, StatusItem, StatusPacket
from ldcnd.drives.ldcn.profiles import PIC_IO, PIC_STEP, PROFILES, Support, at_clock
from ldcnd.drives.ldcn.registers import FASTEST_BAUD, BaudCodes
from ldcnd.drives.ldcn.servo import LdcnAxis
from ldcnd.drives.network import AdoptFallback, BringUpReport, Instant, IoDriver, Network, StartPolicy
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Exchange, Poller, Resync, Timing, next_on_grid
from ldcnd.line.proof import bringing_up
from ldcnd.line.settings import BusSettings
from ldcnd.line.transport import Opener
from ldcnd.log import get_logger

PERIOD_S = 1.0
"""From one question for the status byte of a module that is no axis to the next."""


def watch_module(address: int) -> Exchange[StatusPacket]:
    """Return the question for a module's status byte."""
    return commands.read_status(Node(address, ANY_DIALECT), STATUS_BYTE_ONLY)


class ModuleWatch(Poller[StatusPacket]):
    """One module's status byte.

    Attributes:
        status: the latest, 0 to 255; None while it does not answer.
    """

    def __init__(self, address: int) -> None:
        self.node = address
        self.status: int | None = None
        self.due_at_s = asyncio.get_running_loop().time()
        self.deadline_at_s = self.due_at_s + PERIOD_S
        self._exchange = watch_module(address)

    def next_exchange(self, now_s: float) -> Exchange[StatusPacket]:
        """See `Poller`; a late turn does not shift the next one."""
        self.due_at_s = next_on_grid(self.due_at_s, PERIOD_S, now_s)
        self.deadline_at_s = self.due_at_s + PERIOD_S
        return self._exchange

    @override
    def deliver(self, reply: StatusPacket, timing: Timing) -> None:
        self.status = int(reply.flags)

    @override
    def missed(self, error: BusError) -> None:
        self.status = None


log = get_logger("ldcn")

PLACE_ITEMS = StatusItem.POSITION | StatusItem.VELOCITY
RATE_ATTEMPTS = 2
"""Attempts at Set Baud to the whole line: it is not answered, and one lost packet must not decide on the rate."""


def ldcn_line(
    settings: BusSettings, opener: Opener, specs: tuple[AxisSpec, ...], baud: int, line: LineSpec | None = None
) -> tuple[Bus, "LdcnNetwork"]:
    """Return a bus that is not open yet, and its network; see `LdcnNetwork`."""
    identities: dict[int, Identity] = {}

    def probe(avoid: AbstractSet[int]) -> Exchange[Any] | None:
        # the identity of a module is known beforehand, and no poll has a reply of its length
        candidates = [address for address in identities if address not in avoid] or list(identities)
        return read_identity(candidates[0], identities[candidates[0]]) if candidates else None

    bus = Bus(settings, opener, Resync(flush=NULLS, quiet_s=0.005, settle_s=NULLS_SETTLE_S, probe=probe))
    return bus, LdcnNetwork(bus, specs, baud, line or LineSpec(), identities)


class LdcnNetwork(Network):
    """The chain of modules on one line.

    Args:
        bus: the line.
        specs: its axes.
        baud: the rate to work at.
        line: what else the configuration says of it.
        identities: gets those of the modules that are found; a resynchronisation asks for one of them.
    """

    def __init__(
        self, bus: Bus, specs: tuple[AxisSpec, ...], baud: int, line: LineSpec, identities: dict[int, Identity]
    ) -> None:
        self._bus = bus
        self._baud = self._heard_at = baud
        self._line = line
        self._drives = {
            spec.address: LdcnAxis(spec, at_clock(PROFILES[spec.model], line.clock_hz), bus) for spec in specs
        }
        self._names = {spec.address: spec.name for spec in specs}
        self._identities = identities
        self._watches: dict[int, ModuleWatch | IoModule] = {}
        self._was_up = False
        self._restarted: set[int] = set()  # given their addresses again, on a line that has not come up since
        self._half_reset = False  # an attempt to reset the line has failed: who has received it is not known
        self._disturbed = False  # an attempt to reset the line has failed on the way
        self._all_waited = False  # all modules waited for an address before the line was reset
        self._placed: set[int] = set()
        self._expected = _expected(specs, line)
        plan = GroupPlan(line.groups, self._names)
        self._io = {
            entry.address: IoModule(bus, entry, nth)
            for nth, entry in enumerate(each for each in line.modules if each.name)
        }
        self._all: tuple[LdcnAxis | IoModule, ...] = (*self._drives.values(), *self._io.values())
        self._proofs = {
            each.address: bus.proofs.expect(each.address, each.what, self._names.get(each.address))
            for each in self._expected
        }
        for group in plan.addresses:
            # after a reset every module is in the group of everybody, so a packet to it needs the proofs of all
            members = (address for address in self._proofs if group in (EVERYBODY, plan.place(address).address))
            bus.proofs.expect_group(group, members)
        self._rate = LineRate(
            bus,
            baud,
            BaudCodes.ALTERNATE if line.alternate_divisors else BaudCodes.MANUAL,
            plan.addresses,
            fastest=any(each.profile.top_baud >= FASTEST_BAUD for each in self._expected),
            clock_hz=line.clock_hz,
        )
        self._addressing = Addressing(bus, self._rate, plan)
        self._adoption = Adoption(bus, self._rate, self._expected)
        self._gathering = Gathering(bus, self._rate, self._addressing, self._expected)
        drives = {drive.spec.name: drive for drive in self._drives.values()}
        self.axes: Mapping[str, Drive] = drives
        self._groups = Groups(bus, plan, self._addressing, drives, tuple(self._io.values()), snapshots=line.snapshot)
        self.io: Mapping[str, IoDriver] = {module.name: module for module in self._io.values()}

    # -- bring-up ----------------------------------------------------------------------------------------------------

    async def let_stops_be_heard(self) -> None:
        """See `Network`: where some have answered at the last attempt, else where all were or should be."""
        await self._rate.host_to(self._heard_at)

    async def bring_up(self) -> BringUpReport:
        """See `Network`: take the line over or reset it, as the policy says; every open loop stays open.

        A line that this daemon had up before is taken over if that is possible, whatever the policy.
        """
        with bringing_up():
            try:
                return await self._bring_up()
            except LdcndError:
                # drives that were reset on the way are where the host has gone on
                otherwise = self._bus.baud if self._half_reset else self._heard_at
                self._heard_at = max((each.baud for each in self._adoption.found.values()), default=otherwise)
                with contextlib.suppress(LdcndError):
                    await self.let_stops_be_heard()
                raise

    async def _bring_up(self) -> BringUpReport:
        # until they are found again there is nobody to ask whether the line is in step
        self._identities.clear()
        self._watches.clear()
        self._rate.working = self._baud
        remarks: tuple[str, ...] = ()
        if self._was_up or self._line.start is StartPolicy.ADOPT:
            try:
                adopted = await self._adopt()
            except NetworkMismatch as error:
                await self._check_may_reset(error)
                remarks = (error.message,)
            else:
                found_open = self._open_loops(adopted)
                restarted = frozenset(self._names[address] for address in self._restarted & self._drives.keys())
                report = self._up(adopted.identities, self._take_over(adopted), reset=False)
                return replace(report, open_loops=found_open, restarted=restarted)
        modules, found = await self._start_afresh()
        self._half_reset = False
        for each in self._all:
            each.forget()
        return self._up(modules, remarks + found, reset=True)

    async def _adopt(self) -> Adopted:
        """Take the line over; where only a part of it answers, make the rest audible if more than reading is allowed.

        Raises:
            NetworkMismatch: it cannot be taken over.
        """

        def addressing(address: int) -> None:
            self._restarted.add(address)
            if address in self._drives:
                self._drives[address].forget()
            elif address in self._io:
                self._io[address].forget()

        try:
            return await self._adoption.attempt()
        except NetworkMismatch as error:
            refused = error
        # gathering sets addresses and rates: only on a line that was ours, or that may even be reset
        reads_only = not self._was_up and self._line.adopt_fallback is AdoptFallback.REFUSE
        if reads_only or not self._gathering.possible:
            raise refused
        found = self._adoption.found
        rates = frozenset(each.baud for each in found.values()) or await self._gathering.left_behind()
        if not rates:
            raise refused
        await self._to_one_rate(rates)
        await self._gathering.search(addressing, lambda _: None, left=len(self._expected) - len(found))
        await self._addressing.with_leaders()
        adopted = await self._adoption.attempt()
        if self._restarted.issuperset(self._proofs):
            raise refused  # none of them moves: a reset brings them to the rate of the configuration
        return adopted

    async def _to_one_rate(self, rates: frozenset[int]) -> None:
        """Bring modules that a lost host has left at different rates to one; allowed while motors move."""
        if len(rates) == 1:
            (self._rate.working,) = rates
        for baud in rates - {self._rate.working}:
            await self._rate.host_to(baud)
            await self._addressing.without_leaders()
            await self._rate.everybody_to(self._rate.working)
        await self._rate.host_to(self._rate.working)

    def _open_loops(self, adopted: Adopted) -> frozenset[str]:
        """Return which loops are open, but for those by a command of this host, whose policy of a loss sees to them."""
        return frozenset(
            drive.spec.name
            for address, drive in self._drives.items()
            if not (drive.state.loop_may_open or servo_on(adopted.states[address]))
        )

    def _up(self, modules: Mapping[int, Identity], remarks: tuple[str, ...], *, reset: bool) -> BringUpReport:
        self._identities.clear()
        self._identities.update(modules)
        self._watches = {
            address: self._io.get(address) or ModuleWatch(address) for address in modules if address not in self._drives
        }
        self._groups.proven = reset
        taken_over = "" if reset else TAKEN_OVER
        self._groups.start_barred = taken_over or ("modules that are no axes would obey it" if self._watches else "")
        known = (identity.profile for identity in modules.values())
        capture = all(each is PIC_IO or (each is not None and each.support is Support.FULL) for each in known)
        self._groups.freeze_barred = taken_over or ("" if capture else "a module that captures nothing would obey it")
        for address, drive in self._drives.items():
            drive.identity = str(modules[address])
        for proof in self._proofs.values():
            proof.prove()
        self._gathering.all_placed()
        self._was_up, self._heard_at = True, self._bus.baud
        self._restarted.clear()
        log.info("network up", bus=self._bus.settings.name, modules=len(modules), baud=self._bus.baud, reset=reset)
        return BringUpReport(
            baud=self._bus.baud,
            identities={self._names[address]: str(modules[address]) for address in self._drives},
            reset=reset,
            remarks=remarks,
            placed=frozenset(self._names[address] for address in self._placed if address in self._names),
        )

    def _take_over(self, adopted: Adopted) -> tuple[str, ...]:
        """Learn what the drives are doing that have not restarted; return remarks."""
        self._rate.working = adopted.baud
        known, self._half_reset = self._was_up and not self._half_reset, False
        for address, drive in self._drives.items():
            if address not in self._restarted:
                drive.adopted(adopted.states[address], known=known)
        for address, module in self._io.items():
            if address not in self._restarted:
                module.adopted()
        remarks = [f"taken over as it was, at {adopted.baud} baud; gains are assumed to be those of the configuration"]
        remarks += [f"address {address} had lost power and is disabled" for address in sorted(self._restarted)]
        remarks += [f"address {address}: another host had it add to its replies" for address in adopted.bared]
        if adopted.baud != self._baud:
            remarks.append(f"the configuration asks for {self._baud} baud; the line stays at {adopted.baud}")
        return tuple(remarks)

    async def _check_may_reset(self, refused: NetworkMismatch) -> None:
        """Decide what follows a take-over that was not possible: drives that move are never reset after it.

        Raises:
            NetworkMismatch: nothing: the line stays down.
        """
        if self._line.start is StartPolicy.ADOPT and self._line.adopt_fallback is AdoptFallback.REFUSE:
            raise refused
        obstacles = await self._adoption.not_standing()
        if obstacles:
            unproven = self._gathering.problem
            raise NetworkMismatch(
                f"{refused.message}; not reset either: {'; '.join([*obstacles, *filter(None, (unproven,))])}",
                remedy=unproven.rpartition("; ")[2] or "wait, or stop the motion",
            ) from refused

    async def _start_afresh(self) -> tuple[dict[int, Identity], tuple[str, ...]]:
        """Reset, address, identify, go to the working rate; return who is where, and remarks.

        Raises:
            NetworkMismatch: the drives would be lost by a reset, or are not those of the configuration.
        """
        if not self._rate.changeable and self._bus.baud != self._rate.at_reset:
            raise NetworkMismatch(
                f"bus {self._bus.settings.name}: not reset, as the port stays at {self._bus.baud} baud and the drives"
                f" would restart at {self._rate.at_reset}",
                remedy=f'set the far end to {self._rate.at_reset} baud, or use start = "adopt"',
            )
        # before it begins, since it can be cut short behind any of its packets: from then on nothing is sure to hold
        self._half_reset, self._adoption.found = True, {}
        for each in self._all:
            each.may_have_restarted()
        heard = self._bus.statistics.bytes_in
        first = not (self._was_up or self._disturbed)
        self._all_waited = self._line.proves_places and first and await self._all_wait()
        try:
            if self._disturbed:
                await self._addressing.reset_all()
                await self._addressing.let_all_hear(len(self._expected))
            modules, remarks = await self._reset_and_address()
        finally:
            self._disturbed = self._disturbed or self._bus.statistics.bytes_in > heard  # a line without power is not
        self._placed = await self._places() if self._all_waited else set()
        return modules, remarks

    async def _reset_and_address(self) -> tuple[dict[int, Identity], tuple[str, ...]]:
        for attempt in range(RATE_ATTEMPTS):
            modules = await self._address_afresh(first=not attempt)
            deaf = await self._change_rate(modules)
            if deaf is None:
                await self._addressing.with_leaders()
                return modules, ()
        modules = await self._address_afresh()
        # the rate at which all of them have just answered
        self._rate.working = self._rate.at_reset
        await self._addressing.with_leaders()
        told = f"address {deaf} does not answer at {self._baud} baud; the line stays at {self._rate.at_reset}"
        return modules, (told,)

    async def _address_afresh(self, *, first: bool = False) -> dict[int, Identity]:
        """Bring everybody to the rate of power-up and give out addresses; return who is where.

        Raises:
            NetworkMismatch: they are not those of the configuration, or their order is not proven.
        """
        await self._addressing.call_all()
        # one lost reply makes no silent place: who had an address is asked once more, at the rate it was called to
        if first and self._all_waited and await self._rate.listen(self._expected[0].address):
            self._all_waited = False
        await self._addressing.reset_called()
        modules = await self._addressing.address_all(len(self._expected))
        self._check(modules)
        return modules

    async def _all_wait(self) -> bool:
        """Tell, before a reset, whether all modules wait for an address, and so stand where they were powered on.

        What has an address of an earlier host may have been moved by it. The first module tells: while it waits it
        keeps the next one from receiving. If only some wait, modules meet at one address, the attempt fails, and the
        next one is not the first at which a module answered.
        """
        if (
            not await self._rate.host_to(self._rate.at_reset)
            or await self._rate.who_is(UNADDRESSED, patient=True) is None
        ):
            return False
        others = (*filter(self._bus.offers, self._rate.missed_by), *self._rate.candidates)
        for baud in others if self._rate.changeable else (self._rate.at_reset,):
            if await self._rate.listen(self._expected[0].address, baud):
                return False
        return True

    async def _places(self) -> set[int]:
        """Return which modules stand at 0 after a reset that found them where they were powered on."""
        placed = set()
        for each in self._expected:
            if each.address not in self._drives or each.address in self._addressing.had_address:
                continue
            status = await self._bus.execute(commands.read_status(Node(each.address, each.profile), PLACE_ITEMS))
            if status.position is not None and abs(status.position) <= STILL_COUNTS and not status.velocity:
                placed.add(each.address)
        return placed

    async def _change_rate(self, modules: Mapping[int, Identity]) -> int | None:
        """Move everybody to the working rate; return the first module that did not follow, None if all did."""
        if not self._rate.changeable:
            self._rate.working = self._bus.baud
            return None
        await self._rate.everybody_to(self._rate.working)
        for address, identity in modules.items():
            # "verify that all modules are operating properly at the new Baud rate" (PIC-SERVO manual, 4.1)
            if await self._rate.who_is(address, patient=True) != identity:
                return address
        return None

    def _check(self, modules: Mapping[int, Identity]) -> None:
        """Hold what was found against the configuration.

        A module that is not configured is refused, although it does no harm itself: where any number of modules is
        right, one of which the supply has failed and the next one, which is deaf behind it, are not missed, and the
        modules behind them would get their addresses.

        Raises:
            NetworkMismatch: a configured module is missing or is something else, or one is not configured.
        """
        different = differences(self._expected, modules) + self._surplus(modules)
        if different:
            missing = next((each for each in self._expected if each.address not in modules), None)
            first = f": {missing.what}, address {missing.address}, first, those behind it need it" if missing else ""
            raise NetworkMismatch(
                f"bus {self._bus.settings.name}: {len(modules)} module(s) found within"
                f" {self._rate.reset_s:g} s of the reset, {len(self._expected)} configured; " + "; ".join(different),
                remedy=f"switch on what has no power{first}; correct the wiring or the configuration",
            )

    def _surplus(self, modules: Mapping[int, Identity]) -> tuple[str, ...]:
        """Return in words what is there and not configured, with the lines of the configuration that it needs."""
        known = {each.address for each in self._expected}
        return tuple(
            f"address {address}: {found} is not configured; it needs [[bus.module]] with address = {address} and"
            f' model = "{found.profile.name if found.profile else PIC_STEP.name}"'
            + ("" if found.profile else f", identity = [{found.device_id}, {found.version}]")
            for address, found in sorted(modules.items())
            if address not in known
        )

    async def survey(self) -> Mapping[int, Found]:
        """Find who answers where, by reading only.

        The host is at the rate of the first of them afterwards, or at that of power-up.

        Raises:
            BusError: the line failed meanwhile.
        """
        await self._adoption.search()
        found = dict(sorted(self._adoption.found.items()))
        await self._rate.host_to(next(iter(found.values())).baud if found else self._rate.at_reset)
        return found

    def differences(self, found: Mapping[int, Found]) -> tuple[str, ...]:
        """Return in words what of that is not as configured."""
        return differences(self._expected, {address: each.identity for address, each in found.items()})

    # -- while the line is up ----------------------------------------------------------------------------------------

    @property
    @override
    def modules(self) -> tuple[ModuleInfo, ...]:
        return tuple(self._module(address, identity) for address, identity in sorted(self._identities.items()))

    @property
    @override
    def watches(self) -> tuple[Poller[Any], ...]:
        return tuple(self._watches.values())

    @override
    def incomplete(self) -> bool:
        return not self._bus.proofs.all_hold()

    async def rejoin(
        self, restarted: Callable[[str], None], heard: Callable[[str], None] = lambda _: None
    ) -> frozenset[str]:
        """See `Network`: one search of `Gathering`, and what answers again is identified again."""

        def addressing(address: int) -> None:
            self._proofs[address].lose(f"address {address} has restarted")
            if address in self._drives:
                self._drives[address].forget()
                restarted(self._names[address])
            elif address in self._io:
                self._io[address].forget()

        missing = {
            address: name
            for address, name in self._names.items()
            if self._bus.misses(address) or not self._proofs[address].holds
        }
        back: set[str] = set()

        def reached(address: int) -> None:
            if address in missing and missing[address] not in back:
                back.add(missing[address])
                heard(missing[address])

        with bringing_up():
            await self._gathering.search(addressing, reached)
        for address in await self._identify():
            reached(address)
        if not self.incomplete():
            self._gathering.all_placed()
        self._note_blocked()
        return frozenset(back)

    def _note_blocked(self) -> None:
        """Note which silent modules stand behind another one.

        A module hears nothing while the address output of the one before it is not low (LS-182AP manual, Addressing).
        """
        first = ""
        for each in self._expected:
            proof = self._proofs[each.address]
            proof.blocked_by = first if not proof.holds else ""
            if not (proof.holds or first):
                first = f"{each.what}, address {each.address}"

    @property
    @override
    def problem(self) -> str:
        return self._gathering.problem

    async def _identify(self) -> frozenset[int]:
        """Prove again who answers and was lost; return the addresses of those that are what is configured."""
        found = set()
        for each in self._expected:
            proof = self._proofs[each.address]
            if proof.holds or each.address not in self._identities or self._bus.misses(each.address):
                continue
            identity = await self._rate.who_is(each.address, patient=True)
            if identity is None:
                continue
            if different := each.differs(identity):
                # it answers, so this is no loss of power: a wrong module is at the address
                proof.lose(different, silent=False)
                continue
            if not await self._answers_plainly(each):
                continue
            # at this rate one that lost its power answers as before, with an address that it has saved, and may be
            # energised by what else it has saved (PIC-SERVO SC data sheet, 4.6)
            if each.profile.sc_extensions and self._bus.baud == self._rate.at_reset and each.address in self._drives:
                self._drives[each.address].unseen()
            self._identities[each.address] = identity
            proof.prove()
            found.add(each.address)
        return frozenset(found)

    async def _answers_plainly(self, each: Expected) -> bool:
        """Have a module add nothing to its replies; return whether it has acknowledged that.

        Another program may have told it to: its answers to reads are understood then, and nothing else that it says.
        """
        try:
            with bringing_up():
                await self._bus.execute(commands.define_status(Node(each.address, each.profile), STATUS_BYTE_ONLY))
        except BusError:
            return False
        return True

    @override
    async def stop_together(self, mode: StopMode, names: frozenset[str]) -> None:
        await self._groups.stop(mode, names)

    @override
    async def start_group(self, motions: Mapping[str, CountsMotion], still_wanted: Callable[[], None]) -> None:
        await self._groups.start(motions, still_wanted)

    @override
    async def start_path(self, names: frozenset[str], still_wanted: Callable[[], None]) -> None:
        await self._groups.start_path(names, still_wanted)

    @override
    async def snapshot(self, still_free: Callable[[], None]) -> Instant:
        return await self._groups.snapshot(still_free)

    def _module(self, address: int, identity: Identity) -> ModuleInfo:
        profile = next((each.profile for each in self._expected if each.address == address), identity.profile)
        watch = self._watches.get(address)
        served = self._io.get(address)
        return ModuleInfo(
            address=address,
            title=str(identity),
            model=profile.name if profile else None,
            device_id=identity.device_id,
            version=identity.version,
            axis=self._names.get(address),
            status=watch.status if watch else None,
            name=served.name if served else None,
            outputs=tuple(served.outputs) if served else (),
        )


def _expected(specs: tuple[AxisSpec, ...], line: LineSpec) -> tuple[Expected, ...]:
    """Return what the configuration says is on the line, in the order of the chain."""
    axes = [
        Expected(spec.address, f"axis {spec.name}", PROFILES[spec.model], _override(spec.identity)) for spec in specs
    ]
    others = [
        Expected(module.address, "module", PROFILES[module.model], _override(module.identity))
        for module in line.modules
    ]
    return tuple(sorted(axes + others, key=lambda each: each.address))


def _override(identity: tuple[int, int] | None) -> Identity | None:
    return Identity(*identity) if identity else None
