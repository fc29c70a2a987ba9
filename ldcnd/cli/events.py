"""`ldcnd events`: who moved what, when, with which result."""

from datetime import UTC, datetime

import click

from ldcnd.cli.connection import AXIS, Target, with_target
from ldcnd.cli.typed import Whole, axis_of
from ldcnd.client.events import follow_events, latest_events
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.events import ALARM_HISTORY, DRIVE_CHANGED, REFERENCE, UNSETTLED, CommandEvent


@click.command()
@click.option("--axis", type=AXIS, help="Only this axis.")
@click.option("--count", type=Whole(1, 1000), default=50, show_default=True, help="Maximum number of events.")
@click.option("--follow", is_flag=True, help="Go on with those that come, until Ctrl-C; none is lost silently.")
@with_target
def command(target: Target, axis: str | None, count: int, *, follow: bool) -> None:
    """Show the latest events of the rig, oldest first."""

    async def work(client: RigClient) -> None:
        if axis is not None:
            await axis_of(client, axis)
        if not follow:
            for event in await latest_events(client, count, axis):
                _show(target, event)
            return
        async with follow_events(client, axis) as events:
            for event in await latest_events(client, count, axis):
                _show(target, event)
            async for event in events:
                _show(target, event)

    target.run(work)


def _show(target: Target, event: CommandEvent) -> None:
    at = datetime.fromtimestamp(event.t / 1e9, UTC).isoformat(timespec="milliseconds")
    if event.verb in (ALARM_HISTORY, DRIVE_CHANGED, UNSETTLED, REFERENCE):
        code = f"{event.code}: " if event.code else ""
        target.show(event, f"{at} {event.axis:8} {event.verb:14} {code}{event.reason}")
        return
    who = f"{event.client or 'unnamed'} ({f'login {event.login}' if event.login else 'not authenticated'})"
    why = f": {event.reason}" if event.reason else ""
    target.show(event, f"{at} {event.axis:8} {event.verb:14} {event.status:10} by {who} ({event.command_id}){why}")
