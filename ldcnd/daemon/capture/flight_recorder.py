"""The requests of clients, written into the flight recorders of the lines concerned, between the packets.

A line of the journal is `axis/verb {payload}`, or `@stop/axis {}`, with the payload as JSON. A lease is named by a
fingerprint: a reader of a wire log must not be able to command with what it contains.
"""

import asyncio
import hashlib
import json
from collections.abc import Iterable
from dataclasses import replace

from ldcnd.daemon.clock import Clock
from ldcnd.daemon.line.rig import Rig
from ldcnd.messaging.codec import to_json
from ldcnd.messaging.keys import RIG_ITSELF
from ldcnd.model.commands import Command
from ldcnd.model.frozen import Frozen
from ldcnd.model.rig_commands import ReadWireLog, WireLogReply
from ldcnd.wirelog.recorder import WireEvent, WireRecord

PAGE_BYTES = 12_000
"""Text in one reply: with its other fields it stays below what a payload may have."""
LONGEST_DATA_BYTES = 2_000
"""Of a longer burst, such as noise on a broken line, only the beginning is shown."""
LINE_OVERHEAD_BYTES = 3
"""Quotation marks and comma in JSON."""
STOP = "@stop"


class Journal:
    """Maps an axis to its line; requests that concern the whole rig are written to all lines."""

    def __init__(self, rig: Rig) -> None:
        logs = [(line.bus.wire_log, [axis.config.name for axis in line.axes]) for line in rig.buses]
        self._logs = {name: [log] for log, names in logs for name in names}
        self._logs[RIG_ITSELF] = [log for log, _ in logs]

    def asked(self, axis: str, command: Command[Frozen], lease: str | None = None) -> None:
        """Note a command of an axis or of the rig; `lease` is the token that was given in return."""
        token = lease or getattr(command, "lease", None)
        if token is None:
            payload = to_json(command, exclude_defaults=True)
        else:
            fields = command.model_dump(mode="json", exclude_defaults=True)
            payload = json.dumps({**fields, "lease": fingerprint(token)}, separators=(",", ":")).encode()
        self._note(axis, f"{axis}/{command.verb} ".encode() + payload)

    def stopped(self, axis: str | None) -> None:
        """Note a stop of an axis, or of the rig."""
        what = f"{STOP}/{axis}" if axis else STOP
        self._note(axis or RIG_ITSELF, f"{what} {{}}".encode())

    def _note(self, axis: str, line: bytes) -> None:
        now_s = asyncio.get_running_loop().time()
        for log in self._logs[axis]:
            log.add(now_s, WireEvent.COMMAND, line)


def fingerprint(token: str) -> str:
    """Return a name for a lease that does not give it away."""
    return hashlib.sha256(token.encode()).hexdigest()[:16]


def wire_page(rig: Rig, request: ReadWireLog, clock: Clock) -> WireLogReply:
    """Return the requested records of one line, the oldest first, as many as one reply takes.

    Raises:
        ValueOutOfRange: the rig has no such line.
    """
    service = rig.line(request.bus)
    log = service.bus.wire_log
    records = log.records()
    oldest = log.added - len(records)
    if request.from_record is None:
        since_s = clock.now_s() - request.seconds
        skipped = next((at for at, record in enumerate(records) if record.at_s >= since_s), len(records))
    else:
        skipped = min(max(0, request.from_record - oldest), len(records))
    page = _page(records[skipped:])
    return WireLogReply(
        bus=request.bus,
        family=service.family,
        zero=clock.wall_ns(0.0),
        started=clock.started_s,
        now=clock.now_s(),
        first_record=oldest + skipped,
        next_record=oldest + skipped + len(page),
        end_record=log.added,
        lines=page,
    )


def _page(records: Iterable[WireRecord]) -> tuple[str, ...]:
    """Return as many lines as one reply takes, one at least."""
    lines: list[str] = []
    room = PAGE_BYTES
    for record in records:
        line = str(_shortened(record))
        room -= len(line.encode()) + LINE_OVERHEAD_BYTES
        if lines and room < 0:
            break
        lines.append(line)
    return tuple(lines)


def _shortened(record: WireRecord) -> WireRecord:
    left_out = len(record.data) - LONGEST_DATA_BYTES
    if left_out <= 0:
        return record
    note = f"{record.note} {left_out} more bytes left out".lstrip()
    return replace(record, data=record.data[:LONGEST_DATA_BYTES], note=note)
