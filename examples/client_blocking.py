"""The same without an event loop: `client_blocking.py [ENDPOINT [AXIS]]`."""

import sys

from ldcnd.client.blocking import open_rig
from ldcnd.client.connecting import at
from ldcnd.errors import LdcndError
from ldcnd.model.commands import MoveAbsolute, Power


def main(endpoint: str = "tcp/127.0.0.1:7447", axis: str = "x") -> None:
    """Move an axis to 5 and show how far it is, then ask for too much."""
    with open_rig(at(endpoint)) as rig, rig.control("example", axis, lease_s=1.0) as held:
        held.command(axis, Power(on=True))
        move = held.command(axis, MoveAbsolute(position=5.0, velocity=2.0))
        with rig.follow(move) as motion:
            for step in motion:
                print(f"{step.position:8.3f} {step.unit}, {step.left:8.3f} to go")
        end = rig.wait_for_end(axis, move.command_id)
        print("ended:", end.state, end.last_error or "as asked")
        try:
            held.command(axis, MoveAbsolute(position=1e6))
        except LdcndError as error:
            print("refused:", error.code, error.message)


main(*sys.argv[1:])
