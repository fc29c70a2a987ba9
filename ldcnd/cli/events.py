"""`ldcnd events`: who moved what, when, with which result."""

from datetime import UTC, datetime

import click

from ldcnd.cli.connection import Target, with_target
from ldcnd.client.events import latest_events


@click.command()
@click.option("--axis", help="Only this axis.")
@click.option("--count", type=click.IntRange(1, 1000), default=50, show_default=True, help="At most so many.")
@with_target
def command(target: Target, axis: str | None, count: int) -> None:
    """Show the latest events of the rig, oldest first."""
    for event in target.run(lambda client: latest_events(client, count, axis)):
        at = datetime.fromtimestamp(event.t / 1e9, UTC).isoformat(timespec="milliseconds")
        who = f"{event.client or 'somebody'} ({f'login {event.login}' if event.login else 'not authenticated'})"
        why = f": {event.reason}" if event.reason else ""
        target.show(event, f"{at} {event.axis:8} {event.verb:14} {event.status:10} by {who} ({event.command_id}){why}")
