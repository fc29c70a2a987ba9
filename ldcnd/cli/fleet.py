"""`ldcnd fleet`: every rig, axis, version and health that can be reached."""

import asyncio

import click

from ldcnd.cli.connection import Target, with_target
from ldcnd.cli.typed import Finite
from ldcnd.client.fleet import AxisReport, RigReport, survey
from ldcnd.contract.errors import SessionError
from ldcnd.net.session import Session


@click.command()
@click.option("--watch", type=Finite(min=0.5, max=3600), help="Period of updates, seconds.")
@with_target
def command(target: Target, watch: float | None) -> None:
    """Show every rig across routers: its daemon, its lines and axes, and what is wrong with them.

    With --json, one line for each rig.
    """

    async def work(session: Session) -> None:
        while True:
            fleet = await survey(session, target.rig)
            if not fleet and watch is None:
                raise SessionError(
                    "no rig answers", remedy="start one with `ldcnd run`, or name a router with --connect"
                )
            for rig in fleet:
                target.show(rig, *table(rig))
            if watch is None:
                return
            if not fleet:
                click.echo("no rig answers", err=True)
            await asyncio.sleep(watch)

    target.run_session(work)


def table(rig: RigReport) -> list[str]:
    """Return a rig as lines of text: itself, what is wrong, its axes."""
    version = f"ldcnd {rig.daemon.version}" if rig.daemon else "version unknown"
    lines = [f"{rig.rig}  {version}  run {rig.instance}  {'needs attention' if rig.problems else 'well'}"]
    lines += [f"  ! {problem}" for problem in rig.problems]
    lines += [f"  {_axis(axis)}" for axis in rig.axes]
    return lines


def _axis(axis: AxisReport) -> str:
    info, state, health = axis.info, axis.state, axis.health
    where = f"{info.bus}/{info.address}"
    what = axis.condition.summary
    link = state.link.value if state else "?"
    rate = f"{health.rate_hz:6.1f} Hz" if health else "     ? Hz"
    return f"{info.axis:12} {info.model:14} {where:12} {link:8} {rate}  {what}"
