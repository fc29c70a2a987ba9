"""Pages of a line's flight recorder, small enough for one reply."""

from collections.abc import Iterable
from dataclasses import replace

from ldcnd.bus.wire_log import WireRecord
from ldcnd.daemon.clock import Clock
from ldcnd.daemon.rig import Rig
from ldcnd.model.wire_log import WireLogReply, WireLogRequest

PAGE_BYTES = 12_000
"""Text in one reply: with its other fields it stays below what a payload may have."""
LONGEST_DATA_BYTES = 2_000
"""Of a longer burst, such as noise on a broken line, only the beginning is shown."""
LINE_OVERHEAD_BYTES = 3
"""Quotation marks and comma in JSON."""


def wire_page(rig: Rig, request: WireLogRequest, clock: Clock) -> WireLogReply:
    """Return the records of one line that were asked for, the oldest first, as many as one reply takes.

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
