"""`ldcnd log`: what happened on a rig, one row each, in one order."""

import csv
import sys
import time
from collections.abc import Iterator
from datetime import datetime
from typing import Any

import click
from typing_extensions import override

from ldcnd.cli.connection import AXIS, Target, with_target
from ldcnd.cli.there import check_there
from ldcnd.cli.typed import WholeNumber
from ldcnd.client.events import follow_events
from ldcnd.client.history import Beginning, HistoryKind, HistoryRow, beginning, clock_time, history, row_of
from ldcnd.client.rig_client import RigClient

MOST_ROWS = 1000
SECONDS = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86400.0}


class Since(click.ParamType):  # type: ignore[type-arg] # generic in stubs only
    """An instant: how long ago (90s, 10m, 2h, 1d), or a date and time."""

    name = "since"

    @override
    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        if isinstance(value, int):
            return value
        text = str(value).strip()
        try:
            if text[-1:] in SECONDS and text[:-1].replace(".", "", 1).isdecimal():
                return time.time_ns() - round(float(text[:-1]) * SECONDS[text[-1]] * 1e9)
            at = datetime.fromisoformat(text)
        except ValueError:
            self.fail(
                f"{text!r} is neither a time ago, such as 10m or 2h, nor a date and time, such as 2026-11-25T14:30"
            )
        return round((at if at.tzinfo else at.astimezone()).timestamp() * 1e9)


@click.command()
@click.option("--since", type=Since(), help="Nothing before this: 90s, 10m, 2h or 1d ago, or a date and time.")
@click.option("--axis", type=AXIS, help="Only this axis, I/O module or line.")
@click.option("--kind", type=click.Choice([kind.value for kind in HistoryKind]), multiple=True, help="Only this kind.")
@click.option("--count", type=WholeNumber(1, MOST_ROWS), default=50, show_default=True, help="Maximum number of rows.")
@click.option("--csv", "as_csv", is_flag=True, help="Print CSV, with a row of names first.")
@click.option("--follow", is_flag=True, help="Go on with those that come, until Ctrl-C; no event is lost silently.")
@with_target
def log(
    target: Target,
    since: int | None,
    axis: str | None,
    kind: tuple[str, ...],
    count: int,
    *,
    as_csv: bool,
    follow: bool,
) -> None:
    """Show what happened on the rig: commands, control, faults, what drives did by themselves; oldest first."""
    kinds = kind or tuple(HistoryKind)
    writer = csv.writer(sys.stdout, lineterminator="\n") if as_csv else None

    def show(row: HistoryRow) -> None:
        if writer:
            writer.writerow(getattr(row, name) for name in HistoryRow.model_fields)
            sys.stdout.flush()
        else:
            target.show(row, _line(row))

    async def show_known(client: RigClient) -> None:
        known_from = await beginning(client)
        rows = [row for row in await history(client, known_from, axis, since or 0) if row.kind in kinds]
        for line in _missing(known_from, since, len(rows) - count):
            click.echo(line, err=target.as_json or as_csv)  # a program reads the rows
        for row in rows[-count:]:
            show(row)

    async def work(client: RigClient) -> None:
        if axis is not None:
            await check_there(client, axis, lines=True)
        if writer:
            writer.writerow(HistoryRow.model_fields)
        if not follow:
            await show_known(client)
            return
        lines = {info.axis: info.bus for info in await client.axes()}
        async with follow_events(client, axis) as events:
            await show_known(client)
            async for event in events:
                if (row := row_of(event, lines.get(event.axis))).kind in kinds:
                    show(row)

    (target.follow if follow else target.run)(work)


def _missing(known_from: Beginning, since: int | None, left_out: int) -> Iterator[str]:
    """Yield what is to be said of rows that are not shown."""
    if left_out <= 0 if since is None else since <= known_from.t:
        yield str(known_from)
    if left_out > 0:
        yield f"{left_out} earlier rows are left out: --count takes up to {MOST_ROWS}"


def _line(row: HistoryRow) -> str:
    at = clock_time(row.t)
    who = f" by {row.who}" if row.who else ""
    where = "" if row.target is None else f" to {row.target:.6g}"
    where += "" if row.position is None else f" at {row.position:.6g}"
    where += "" if row.last_position is None else f" last read at {row.last_position:.6g}"
    named = f" ({row.command_id})" if row.command_id and row.how else ""
    why = f": {row.why}" if row.why else ""
    return f"{at} {row.kind:8}{row.axis:8} {row.what:16} {row.how:10}{who}{where}{named}{why}"
