"""The same without an event loop: `client_blocking.py [ENDPOINT [AXIS]]`."""

import sys

import ldcnd


def main(endpoint: str | None = None, axis: str = "x") -> None:
    """Move an axis to 5 and show how far it is, then ask for too much."""
    with ldcnd.connect_blocking(endpoint) as rig, rig.control(axis, client="example", lease_s=1.0) as x:
        x.power(on=True)
        move = x.move_absolute(5, velocity=2)
        for step in move:
            print(f"{step.position:8.3f} {step.unit}, {step.left:8.3f} to go")
        print("ended:", move.done())
        try:
            x.move_absolute(1e6)
        except ldcnd.LdcndError as error:
            print("refused:", error.code, error.message)


main(*sys.argv[1:])
