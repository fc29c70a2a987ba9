"""The flight recorder of a line, fetched page by page."""

from dataclasses import dataclass

from ldcnd.client.rig_client import RigClient
from ldcnd.contract.rig_commands import ReadWireLog


@dataclass(frozen=True, slots=True)
class FetchedWireLog:
    """The records of a line.

    Attributes:
        bus: the line.
        family: the drive family on it.
        zero_ns: the wall time at which the records' clock was 0, UTC in ns since 1970.
        started_s: what that clock showed when the daemon was started.
        now_s: the time of that clock at the request.
        first_record: number of the first record, counted since the daemon started.
        lines: one record each.
        lost: how many records were overwritten while the pages were fetched.
    """

    bus: str
    family: str
    zero_ns: int
    started_s: float
    now_s: float
    first_record: int
    lines: tuple[str, ...]
    lost: int


async def fetch_wire_log(client: RigClient, bus: str, seconds: float) -> FetchedWireLog:
    """Fetch the last seconds of a line up to now; what happens while the pages travel is left out.

    Raises:
        LdcndError: as the daemon refused it, of the same class.
    """
    page = await client.ask(ReadWireLog(bus=bus, seconds=seconds))
    first, end = page, page.end_record
    lines = list(page.lines)
    lost = 0
    while page.next_record < end:
        wanted = page.next_record
        request = ReadWireLog(bus=bus, seconds=seconds, from_record=wanted)
        page = await client.ask(request)
        lost += min(page.first_record, end) - wanted
        lines += page.lines[: max(0, end - page.first_record)]
    return FetchedWireLog(
        first.bus, first.family, first.zero, first.started, first.now, first.first_record, tuple(lines), lost
    )
