"""Examining an LDCN/NMC line by reading only: adapter, drives, how long replies take, what that costs.

Sends nulls, Read Status and No Operation: drives that move go on, drives without an address keep none.
"""

import asyncio
import math
from collections.abc import AsyncGenerator, Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from ldcnd.contract.errors import BusError, LdcndError
from ldcnd.contract.health import Finding, Verdict
from ldcnd.contract.samples import TelemetryItem
from ldcnd.drives.cost import LineTiming, PriceList, cost_of
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.adoption import Found
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.family import price_list
from ldcnd.drives.ldcn.identity import ANY_DIALECT, UNADDRESSED, read_identity
from ldcnd.drives.ldcn.network import LdcnNetwork
from ldcnd.drives.ldcn.registers import SERVO_CYCLE_S
from ldcnd.line.adapter import Adapter, adapter_of
from ldcnd.line.bus import Bus
from ldcnd.line.exchange import Exchange
from ldcnd.line.flight_recorder import WireEvent, WireRecord
from ldcnd.line.port_url import device_of

EXCHANGES = 100
"""Number of exchanges with each drive: they include the shortest and the longest wait for a servo cycle's end."""
ALMOST_ALL = 0.99
"""One reply of a hundred may be late for other reasons: the host was busy."""
STEP_MS = 0.1
CLOSE_MS = 0.3
"""The plan and what was measured differ by no more than what hosts differ from one run to the next."""
MARGIN_FACTOR = 3
"""Factor from the slowest reply's time beyond its plan to the deadline."""
RULES = "permanently: the udev rules of the package (deploy/udev/71-ldcnd.rules)"


@dataclass(frozen=True, slots=True)
class LineAsConfigured:
    """The configuration of the line.

    Attributes:
        port: device path, or another kind of port.
        adapter_latency_ms: what the plan reckons with.
        margin_ms: what is added to each reply's deadline.
        model: of most drives on it, for what a poll costs.
    """

    name: str
    port: str
    adapter_latency_ms: float
    margin_ms: float
    model: str


@dataclass(frozen=True, slots=True)
class Held:
    """How long replies took beyond their bytes, in seconds: servo cycle, adapter, kernel.

    Attributes:
        times_s: one for each reply, ascending.
    """

    times_s: tuple[float, ...]

    @property
    def longest_s(self) -> float:
        """The reply time that nearly all replies stay below."""
        return self.times_s[min(len(self.times_s) - 1, int(ALMOST_ALL * len(self.times_s)))]

    @property
    def adapter_ms(self) -> float:
        """The part of it due to the adapter and the kernel, rounded up."""
        beyond_s = max(0.0, self.longest_s - SERVO_CYCLE_S)
        return math.ceil(beyond_s * 1000 / STEP_MS - 1e-9) * STEP_MS

    @classmethod
    def of(cls, records: list[WireRecord], byte_s: float) -> "Held":
        """Return it from what was on the wire, each request with one reply."""
        times_s = []
        sent, received = None, 0
        for record in records:
            if record.event is WireEvent.SENT:
                sent, received = record, 0
            elif record.event in (WireEvent.PART, WireEvent.RECEIVED) and sent:
                received += len(record.data)
                if record.event is WireEvent.RECEIVED:
                    times_s.append(record.at_s - sent.at_s - (len(sent.data) + received) * byte_s)
                    sent = None
        return cls(tuple(sorted(times_s)))


async def examine(
    bus: Bus, network: LdcnNetwork, line: LineAsConfigured, look: Callable[[Path], Adapter | None] = adapter_of
) -> AsyncGenerator[Finding]:
    """Examine an open line that has no other user; yields each finding as it comes.

    Args:
        bus: open.
        network: whose drives are expected.
        line: what the configuration says of it.
        look: returns the kernel's data of an adapter.
    """
    for finding in adapter_findings(line, look(device) if (device := device_of(line.port)) else None):
        yield finding
    before = bus.line_errors()
    try:
        found = await network.survey()
        yield _drives(line.name, network, found)
        if not found:
            yield await _unaddressed(bus, line.name)
            return
        held = await measured(bus, found)
    except BusError as error:
        yield Finding(axis=line.name, what="line", verdict=Verdict.WRONG, text=error.message, remedy=error.remedy)
        return
    for finding in (*_timing(line, bus, held), lost_on_line(line.name, bus, before)):
        yield finding


# -- the adapter -----------------------------------------------------------------------------------------------------


def adapter_findings(line: LineAsConfigured, adapter: Adapter | None) -> list[Finding]:
    """Return what is to be said of an adapter, and what to type where it keeps replies back."""

    def finding(what: str, verdict: Verdict, text: str, remedy: str | None = None) -> Finding:
        return Finding(axis=line.name, what=what, verdict=verdict, text=text, remedy=remedy)

    if adapter is None:
        text = f"{line.port}: no serial port of this machine; nothing is known of what lies between"
        return [finding("adapter", Verdict.FINE, text)]
    if not adapter.driver:
        return [finding("adapter", Verdict.FINE, f"{adapter.node}: a pseudo-terminal")]
    findings = [finding("adapter", Verdict.FINE, f"{adapter.node}: driver {adapter.driver}")]
    if not line.port.startswith(("/dev/ldcn-", "/dev/serial/by-")) and adapter.node.startswith(("ttyUSB", "ttyACM")):
        stable = f'port = "{adapter.stable_name}"' if adapter.stable_name else "install the udev rules of the package"
        text = f"{line.port} may be called otherwise when it is plugged in again"
        findings.append(finding("name", Verdict.LOOK, text, stable))
    if (timer_ms := adapter.latency_timer_ms) is not None:
        text = f"the chip keeps a short reply back for {timer_ms} ms"
        slow = timer_ms > 1
        remedy = f"echo 1 | sudo tee {adapter.latency_file}; {RULES}" if slow else None
        findings.append(finding("latency timer", Verdict.LOOK if slow else Verdict.FINE, text, remedy))
    if (trigger := adapter.rx_trig_bytes) is not None:
        slow = trigger > 1
        text = f"the FIFO hands over {trigger} bytes at once, or what it has after four characters of silence"
        remedy = f"echo 1 | sudo tee {adapter.trigger_file}; {RULES}" if slow else None
        findings.append(finding("FIFO trigger", Verdict.LOOK if slow else Verdict.FINE, text, remedy))
    return findings


# -- the drives ------------------------------------------------------------------------------------------------------


def _drives(line: str, network: LdcnNetwork, found: Mapping[int, Found]) -> Finding:
    rates = ", ".join(sorted({str(each.baud) for each in found.values()})) or "any rate"
    named = "; ".join(f"{address}: {each.identity} at {each.baud} baud" for address, each in found.items())
    problems = network.differences(found)
    if problems:
        text = f"{len(found)} answer at {rates}{': ' + named if named else ''}; {'; '.join(problems)}"
        remedy = "switch everything on, check the wires, correct the configuration"
        return Finding(axis=line, what="drives", verdict=Verdict.LOOK, text=text, remedy=remedy)
    return Finding(axis=line, what="drives", verdict=Verdict.FINE, text=named)


async def _unaddressed(bus: Bus, line: str) -> Finding:
    """Probe for a drive that has just been powered up: it is at address 0, and the first one receives the host."""
    try:
        await bus.execute(read_identity(UNADDRESSED.address))
    except LdcndError:
        text = "no drive answers, addressed or not"
        remedy = "check power, the transmit and receive pairs (swapped?), and the ground between host and drives"
        return Finding(axis=line, what="line", verdict=Verdict.WRONG, text=text, remedy=remedy)
    text = "the first drive answers and has no address yet: the line was not used since power-up"
    remedy = "start the daemon once, which gives addresses, end it, and examine the line again"
    return Finding(axis=line, what="line", verdict=Verdict.LOOK, text=text, remedy=remedy)


# -- how long replies take -------------------------------------------------------------------------------------------


async def measured(bus: Bus, found: Mapping[int, Found]) -> Held:
    """Poll every drive at the host's rate repeatedly; nothing is sent twice when a reply is lost.

    Raises:
        BusError: the line failed.
    """
    from_s = bus.wire_log.records()[-1].at_s
    for address, each in found.items():
        if each.baud != bus.baud:
            continue
        node = Node(address, each.identity.profile or ANY_DIALECT)
        for number in range(EXCHANGES):
            await asyncio.sleep(SERVO_CYCLE_S * number / EXCHANGES)  # or all might meet the same part of a cycle
            await bus.execute(commands.no_operation(node))
    records = [record for record in bus.wire_log.records() if record.at_s > from_s]
    return Held.of(records, bus.settings.bits_per_byte / bus.baud)


def _timing(line: LineAsConfigured, bus: Bus, held: Held) -> list[Finding]:
    if not held.times_s:
        text = "no drive answers at the rate of the first one, so the response time cannot be measured"
        return [Finding(axis=line.name, what="turn-around", verdict=Verdict.LOOK, text=text)]
    shortest, middle, longest = (1000 * time_s for time_s in (held.times_s[0], median(held.times_s), held.longest_s))
    text = (
        f"beyond their bytes replies took {shortest:.2f} to {longest:.2f} ms, half of them {middle:.2f} ms; servo"
        f" cycles explain {1000 * SERVO_CYCLE_S:.2f} ms, so the adapter keeps them back for {held.adapter_ms:.1f} ms"
    )
    planned = abs(held.adapter_ms - line.adapter_latency_ms) <= CLOSE_MS
    told = None if planned else f"adapter_latency_ms = {held.adapter_ms:.1f}"
    findings = [
        Finding(
            axis=line.name,
            what="turn-around",
            verdict=Verdict.FINE if planned else Verdict.LOOK,
            text=f"{text}; the plan reckons with {line.adapter_latency_ms:g} ms",
            remedy=told,
        ),
        _cost(line, bus.baud, held),
    ]
    needed_ms = math.ceil(MARGIN_FACTOR * held.adapter_ms)
    if line.margin_ms < needed_ms:
        text = f"margin_ms = {line.margin_ms:g} leaves little for replies that are {held.adapter_ms:.1f} ms late"
        findings.append(
            Finding(axis=line.name, what="margin", verdict=Verdict.LOOK, text=text, remedy=f"margin_ms = {needed_ms}")
        )
    return findings


def _cost(line: LineAsConfigured, baud: int, held: Held) -> Finding:
    """Say how many polls a second the adapter costs."""
    prices = price_list(line.model, baud)
    with_it_hz, without_hz = (polls_hz(prices, baud, latency_ms) for latency_ms in (held.adapter_ms, 0.0))
    text = f"{with_it_hz:.0f} polls a second fit on the line; {without_hz:.0f} with an adapter that keeps nothing back"
    slow = with_it_hz < without_hz / 2
    return Finding(axis=line.name, what="cost", verdict=Verdict.LOOK if slow else Verdict.FINE, text=text)


def polls_hz(prices: PriceList, baud: int, latency_ms: float) -> float:
    """Return how many polls of everything fit on a line in a second."""
    reading: Exchange[object] = prices.reading(frozenset(TelemetryItem))
    return 1.0 / cost_of(reading, LineTiming(baud, prices.node_baud, adapter_latency_s=latency_ms / 1000)).mean_s


def lost_on_line(line: str, bus: Bus, before: object) -> Finding:
    """Say what was lost on a line since a count of the driver's."""
    statistics, after = bus.statistics, bus.line_errors()
    counted = after.since(before) if after and isinstance(before, type(after)) else None
    lost = statistics.corrupt_replies + statistics.rejected_packets + statistics.stray_bytes
    text = (
        f"{statistics.replies} replies, {statistics.corrupt_replies} damaged, {statistics.rejected_packets} packets"
        f" rejected by a drive, {statistics.stray_bytes} stray bytes; the driver counted {counted or 'no errors'}"
    )
    if not (lost or counted):
        return Finding(axis=line, what="errors", verdict=Verdict.FINE, text=text)
    remedy = "check termination (120 ohm at both ends of a pair), bias of idle pairs, ground, shield, and the rate"
    return Finding(axis=line, what="errors", verdict=Verdict.LOOK, text=text, remedy=remedy)
