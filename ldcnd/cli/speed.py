"""`ldcnd speed`: the speed override of a rig."""

import click

from ldcnd.cli.connection import of_options
from ldcnd.cli.output import show_lines
from ldcnd.cli.quantities import rounded
from ldcnd.cli.sending import NAME, Sender, commanding
from ldcnd.cli.typed import Finite
from ldcnd.client.rig_client import RigClient
from ldcnd.contract.rig_commands import SetSpeedOverride


@click.command()
@click.argument("percent", type=Finite(0, 100), required=False)
@commanding
def command(sender: Sender, percent: float | None) -> None:
    """Set the speed override of the rig to PERCENT of every velocity; without PERCENT show it.

    At 0 what moves is halted and nothing begins. Raising it needs control of the axes where moving them would.
    """

    async def shown(client: RigClient) -> str:
        states = [await client.state(info.axis) for info in await client.axes()]
        return ", ".join(sorted({f"{rounded(state.speed_override)} %" for state in states if state}))

    if percent is None:
        show_lines(sender.target.run(shown))
        return
    leases = (sender.lease,) if sender.lease else ()
    request = of_options(SetSpeedOverride, percent=percent, leases=leases, client=None if sender.lease else NAME)
    reply = sender.target.run(lambda client: client.ask(request))
    told = [f"{axis}: goes on at another speed" for axis in reply.changed] + [
        f"{axis}: halted" for axis in reply.halted
    ]
    sender.target.show(reply, f"speed override {rounded(reply.percent)} %", *told)
