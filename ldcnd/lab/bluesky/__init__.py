"""Axes as Bluesky devices: for a RunEngine, and for all that speaks `bluesky.protocols`.

    from bluesky import RunEngine
    from bluesky.plans import scan
    import ldcnd.bluesky

    RE = RunEngine()
    with ldcnd.bluesky.connect() as rig, rig.control("x", client="scan") as x:
        x.power(on=True).wait()
        RE(scan([rig.signal("y", "velocity")], x, 0, 10, 11))

The devices stand on `ldcnd.connect` and run on an event loop in a thread of their own: what a plan, a callback or a
plot does with the RunEngine's loop delays no renewal of a lease. They satisfy the protocols structurally, so Bluesky
itself is not needed to make them.
"""

from ldcnd.lab.bluesky.axis import PlanAxis, ReadableAxis
from ldcnd.lab.bluesky.devices import Devices, connect
from ldcnd.lab.bluesky.flight import Flight, Fly
from ldcnd.lab.bluesky.setting import Setting
from ldcnd.lab.bluesky.signal import Signal
from ldcnd.lab.bluesky.status import Status
from ldcnd.lab.bluesky.trace import TraceDetector

__all__ = [
    "Devices",
    "Flight",
    "Fly",
    "PlanAxis",
    "ReadableAxis",
    "Setting",
    "Signal",
    "Status",
    "TraceDetector",
    "connect",
]
