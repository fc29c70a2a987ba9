"""Scan of an unknown LDCN/NMC line: which modules are there, at which rate, in which state.

Listens first, then sends nulls and Read Status: nothing moves, no module loses its state or gets an address. Only on
request, a line on which nothing can be moving is reset and addressed.
"""

import asyncio
import json
from collections.abc import AsyncGenerator, Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ldcnd.bench.family import ScannedDrive
from ldcnd.bench.ldcn.examination import LineAsConfigured, adapter_findings, lost_on_line, measured, polls_hz
from ldcnd.contract.errors import BusDown, BusError
from ldcnd.contract.health import Finding, Verdict
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.addressing import MOST_MODULES, Addressing
from ldcnd.drives.ldcn.adoption import MOTION_ITEMS, STILL_COUNTS, WATCH_S, Found
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.family import price_list
from ldcnd.drives.ldcn.faults import Knowledge, diagnose
from ldcnd.drives.ldcn.group_plan import EVERYBODY, GroupPlan
from ldcnd.drives.ldcn.identity import ANY_DIALECT, UNADDRESSED, Identity
from ldcnd.drives.ldcn.line_rate import LineRate
from ldcnd.drives.ldcn.packet import AuxFlag, StatusFlag, StatusPacket
from ldcnd.drives.ldcn.profiles import PIC_IO, PROFILES, Profile, Support
from ldcnd.drives.ldcn.registers import RESET_BAUD, BaudCodes
from ldcnd.line.adapter import Adapter, adapter_of
from ldcnd.line.bus import Bus
from ldcnd.line.port_url import device_of
from ldcnd.line.proof import bringing_up

LISTENED_S = 0.5
"""A host that polls a line does so more often."""
MARGIN_MS = 50.0
"""Margin for an adapter that is not examined yet: it may keep replies back for 16 ms."""
USUAL_BAUD = 115_200
"""The rate that every drive of the manuals reaches."""
CLOSE_BY = 3
"""Addresses after the last answer that are probed with patience: chains are numbered without gaps."""


@dataclass(frozen=True, slots=True)
class ScannedModule:
    """The state of one module.

    Attributes:
        at_rest: it stands with its loop open; None where that is unknown.
        words: its state, for a person.
    """

    at_rest: bool | None
    words: str


class LineScan:
    """A scan of one line, open and without other users.

    Attributes:
        drives: what was found; complete when `findings` has ended.
    """

    def __init__(
        self, bus: Bus, port: str, *, give_addresses: bool, look: Callable[[Path], Adapter | None] = adapter_of
    ) -> None:
        self.drives: list[ScannedDrive] = []
        self._bus = bus
        self._port = port
        self._give_addresses = give_addresses
        self._look = look
        self._rate = LineRate(bus, RESET_BAUD, BaudCodes.MANUAL, (EVERYBODY,), fastest=True)
        self._waiting: list[int] = []  # rates at which a module without an address answers

    async def findings(self) -> AsyncGenerator[Finding]:
        """Run the scan; yields each finding as it comes."""
        line = LineAsConfigured(self._port, self._port, 0.0, MARGIN_MS, ANY_DIALECT.name)
        for finding in adapter_findings(line, self._look(device) if (device := device_of(self._port)) else None):
            yield finding
        before = self._bus.line_errors()
        try:
            await asyncio.sleep(LISTENED_S)
            if heard := self._bus.statistics.stray_bytes:
                yield self._wrong(
                    f"{heard} bytes came within {LISTENED_S:g} s without a request: another host uses the line",
                    "end that program, then scan again",
                )
                return
            found = await self._find_all()
            seen = await self._watch(found)
            if self._give_addresses and (found or self._waiting):  # where nothing answers nothing is known to stand
                refusal = self._why_not(found, seen)
                if refusal:
                    yield refusal
                else:
                    found = await self._address()
                    seen = await self._watch(found)
            for finding in self._drives(found, seen):
                yield finding
            async for finding in self._timing(found):
                yield finding
        except BusError as error:
            yield self._wrong(error.message, error.remedy)
            return
        yield lost_on_line(self._port, self._bus, before)

    def _finding(self, what: str, verdict: Verdict, text: str, remedy: str | None = None) -> Finding:
        return Finding(axis="line", what=what, verdict=verdict, text=text, remedy=remedy)

    def _wrong(self, text: str, remedy: str | None = None) -> Finding:
        return self._finding("line", Verdict.WRONG, text, remedy)

    # -- who is there ------------------------------------------------------------------------------------------------

    async def _find_all(self) -> dict[int, Found]:
        """Probe every address that a chain gives at every rate, with patience where others of the chain answer."""
        found: dict[int, Found] = {}
        for baud in reversed(self._rate.candidates):
            if not await self._rate.host_to(baud):
                continue
            received = self._bus.statistics.bytes_in
            here: dict[int, Identity] = {}
            for address in range(1, MOST_MODULES + 1):
                if address in found:
                    continue
                close = bool(here) and address <= max(here) + CLOSE_BY
                if identity := await self._rate.who_is(address, patient=close):
                    here[address] = identity
            if self._bus.statistics.bytes_in > received:  # a reply may have been lost, also the first
                for address in range(1, max(here, default=0) + CLOSE_BY + 1):
                    if address in found or address in here:
                        continue
                    if identity := await self._rate.who_is(address, patient=True):
                        here[address] = identity
            if await self._rate.who_is(UNADDRESSED.address, patient=True):
                self._waiting.append(baud)
            found |= {address: Found(baud, identity) for address, identity in here.items()}
        return dict(sorted(found.items()))

    async def _watch(self, found: dict[int, Found]) -> dict[int, ScannedModule]:
        """Read every module twice; what moves in between moves."""
        before = await self._states(found)
        await asyncio.sleep(WATCH_S)
        after = await self._states(found)
        return {address: _seen(each.identity, before[address], after[address]) for address, each in found.items()}

    async def _states(self, found: dict[int, Found]) -> dict[int, StatusPacket | None]:
        states: dict[int, StatusPacket | None] = {}
        for address, each in found.items():
            profile = each.identity.profile
            states[address] = None
            if profile and profile.support is Support.FULL and await self._rate.host_to(each.baud):
                exchange = commands.read_status(Node(address, profile), MOTION_ITEMS)
                try:
                    status = await self._bus.execute(exchange)
                except BusDown:
                    raise
                except BusError:
                    continue  # its state is not known then
                states[address] = status
        return states

    # -- giving addresses --------------------------------------------------------------------------------------------

    def _why_not(self, found: dict[int, Found], seen: dict[int, ScannedModule]) -> Finding | None:
        """Return what keeps a line that answers from being reset; None when nothing on it can be moving."""
        obstacles = [f"address {address}: {seen[address].words}" for address in found if not seen[address].at_rest]
        if found and self._waiting:
            obstacles.append("modules behind the one without an address cannot be reached, and may move")
        if not obstacles:
            return None
        text = f"not reset, no addresses given: {'; '.join(obstacles)}"
        return self._wrong(text, "switch motor power off, or start a daemon, which brings such a line back by itself")

    async def _address(self) -> dict[int, Found]:
        """Reset the line and give addresses in the order of the chain."""
        addressing = Addressing(self._bus, self._rate, GroupPlan((), {}))
        with bringing_up():
            await addressing.reset_all()
            identities = await addressing.address_all(0)
        self._waiting.clear()
        return {address: Found(self._rate.at_reset, identity) for address, identity in identities.items()}

    # -- what that means ---------------------------------------------------------------------------------------------

    def _drives(self, found: dict[int, Found], seen: dict[int, ScannedModule]) -> list[Finding]:
        findings = []
        for address, each in found.items():
            profile = each.identity.profile
            model = profile.name if profile else None
            is_axis = bool(profile and profile.support is Support.FULL)
            text = f"{each.identity} at {each.baud} baud; {seen[address].words}"
            self.drives.append(ScannedDrive(address, model, is_axis, each.baud, text))
            verdict = Verdict.FINE if profile else Verdict.LOOK
            findings.append(Finding(axis=str(address), what="drive", verdict=verdict, text=text))
        rates = sorted({each.baud for each in found.values()})
        if len(rates) > 1:
            text = f"the drives are at different rates: {', '.join(map(str, rates))} baud"
            findings.append(
                self._finding("rates", Verdict.LOOK, text, "a daemon that resets the line brings all to one rate")
            )
        findings += [
            self._finding(
                "addresses",
                Verdict.LOOK,
                f"a module without an address waits at {baud} baud; those behind it in the chain cannot be reached",
                "`ldcnd scan PORT --address` gives addresses on a line where nothing moves; so does a daemon",
            )
            for baud in self._waiting
        ]
        known = [profile for each in found.values() if (profile := each.identity.profile)]
        if len(known) > 1:
            findings.append(self._order(known))
        if not found and not self._waiting:
            findings.append(self._no_answer())
        return findings

    def _order(self, known: list[Profile]) -> Finding:
        """Say from which end the chain is numbered: equal drives are told apart by nothing else."""
        ends = {
            "next to the host": dict.fromkeys(each.title for each in known if each.numbered_from_host),
            "furthest from the host, as those chains are customarily wired": dict.fromkeys(
                each.title for each in known if not each.numbered_from_host
            ),
        }
        said = [
            f"where the chain begins with {' or '.join(models)}, address 1 is {end}"
            for end, models in ends.items()
            if models
        ]
        alike = any(known.count(each) > 1 for each in known)
        return self._finding(
            "order",
            Verdict.LOOK if alike else Verdict.FINE,
            "; ".join(said),
            "equal drives look alike: `ldcnd commission AXIS --step motor` moves one and asks which it was"
            if alike
            else None,
        )

    def _no_answer(self) -> Finding:
        received = self._bus.statistics.bytes_in
        if received:
            text = f"no module answers in words, but {received} bytes came back: two modules at one address, or noise"
            remedy = "look at termination (120 ohm at both ends of a pair), ground and shield; power-cycle all drives"
        else:
            text = "nothing comes back at any rate"
            remedy = "check power, the transmit and receive pairs (swapped?), and the ground between host and drives"
        return self._wrong(text, remedy)

    async def _timing(self, found: dict[int, Found]) -> AsyncGenerator[Finding]:
        """Say what the adapter and the line cost, at the rate of most drives."""
        usable = {
            address: each
            for address, each in found.items()
            if (profile := each.identity.profile) and profile.support is Support.FULL
        }
        if not usable:
            return
        rates = [each.baud for each in usable.values()]
        baud = max(rates, key=lambda each: (rates.count(each), each))
        if not await self._rate.host_to(baud):
            return
        held = await measured(self._bus, {address: each for address, each in usable.items() if each.baud == baud})
        models = [profile.name for each in usable.values() if (profile := each.identity.profile)]
        now_hz = polls_hz(price_list(models[0], baud), baud, held.adapter_ms)
        fast_hz = polls_hz(price_list(models[0], USUAL_BAUD), USUAL_BAUD, held.adapter_ms)
        text = (
            f"the adapter keeps replies back for {held.adapter_ms:.1f} ms; at {baud} baud {now_hz:.0f} polls a second"
            f" fit on the line, {now_hz / len(usable):.0f} of each drive; at {USUAL_BAUD} baud {fast_hz:.0f}"
        )
        yield self._finding("cost", Verdict.FINE, text, f"adapter_latency_ms = {held.adapter_ms:.1f}")


def _seen(identity: Identity, before: StatusPacket | None, after: StatusPacket | None) -> ScannedModule:
    profile = identity.profile
    if profile is None or profile.support is not Support.FULL:
        return ScannedModule(profile is PIC_IO or None, "its status is not read" if profile else "an unknown device")
    if before is None or after is None:
        return ScannedModule(None, "its state could not be read")
    aux = after.aux or AuxFlag(0)
    moved = abs((after.position or 0) - (before.position or 0))
    words = []
    if moved > STILL_COUNTS or before.velocity or after.velocity:
        words.append(f"moves, {moved / WATCH_S:.0f} counts a second")
    else:
        words.append("stands")
    words.append("loop closed" if aux & AuxFlag.SERVO_ON else "loop open")
    words += [
        word
        for flag, word in ((AuxFlag.PATH_MODE, "a path runs"), (AuxFlag.MOTION_LOCKED, "motion locked"))
        if flag in aux
    ]
    if StatusFlag.HOME_IN_PROGRESS in after.flags:
        words.append("a home search is armed")
    faults = diagnose(profile, after, Knowledge(closed=bool(aux & AuxFlag.SERVO_ON)))
    words += [fault.code.replace("_", " ") for fault in faults]
    words.append(f"at {after.position} counts")
    return ScannedModule(len(words) > 1 and words[0] == "stands" and not aux & AuxFlag.SERVO_ON, ", ".join(words))


def configured_line(name: str, port: str, drives: Sequence[ScannedDrive]) -> str:
    """Return the `[[bus]]` table of a line; its rate is one that all modules on it reach."""
    tops = [PROFILES[drive.model].top_baud for drive in drives if drive.model]
    baud = USUAL_BAUD if all(top >= USUAL_BAUD for top in tops) else RESET_BAUD
    seen = ", ".join(sorted({str(drive.baud) for drive in drives}))
    device = device_of(port)
    adapter = adapter_of(device) if device else None
    simulated = adapter is not None and not adapter.driver
    margin = "margin_ms = 200  # behind a pseudo-terminal a program answers, when it gets to it"
    return f"""
[[bus]]
name = "{name}"
port = {json.dumps(port)}
baud = {baud}  # the drives are brought to it; they were found at {seen}
# adapter_latency_ms = MILLISECONDS  # the finding "cost" of the scan tells what it measured
{margin if simulated else "# margin_ms = 25"}
# start = "adopt"  # takes drives over as they are; "reset", the default, resets and addresses them
"""


def configured_drive(name: str, drive: ScannedDrive) -> str:
    """Return the table of what was found at an address; modules that are no axes have no names."""
    if drive.is_axis:
        return f"""
[[bus.axis]]  # {drive.text}
name = "{name}"
address = {drive.address}
model = "{drive.model}"
unit = "count"  # your unit, and counts_per_unit = encoder counts of one of it
velocity = 1000  # the default of moves, in units a second
acceleration = 5000
# limits = {{ position_min = -10000, position_max = 10000, velocity = 2000, acceleration = 10000 }}
# gains = {{ kp = 100, kd = 1000, ki = 50, il = 200, ol = 255, el = 1000 }}  # without gains the loop stays open
# home = {{ method = "index", velocity = 100 }}
"""
    return f"""
[[bus.module]]  # {drive.text}
address = {drive.address}
model = "{drive.model}"
"""
