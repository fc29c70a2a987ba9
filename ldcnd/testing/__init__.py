"""Rehearse programs that move machines: a whole daemon, its lines and its drives inside a test, on a clock that jumps.

    async def test_the_scan_stops_where_something_jams(ldcnd_rig):
        ldcnd_rig.faults.jam("x", at=7.5)
        with pytest.raises(ldcnd.DriveFault):
            await my_scan(ldcnd_rig.client)
        assert ldcnd_rig.truth("x").at_rest

With pytest the fixtures `ldcnd_rig` and, in real time for other processes, `ldcnd_served_rig` are there as soon as
ldcnd is installed; without it, `run`, `simulated_rig` and `served_rig` do the same.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from ldcnd.testing.faults import FaultSpan, FaultStart, RigFault, RigFaults
    from ldcnd.testing.lines import simulated_config
    from ldcnd.testing.rig import SimulatedRig, run, simulated_rig
    from ldcnd.testing.served import ServedRig, served_rig
    from ldcnd.testing.truth import ModuleTruth, Truth

__all__ = [
    "FaultSpan",
    "FaultStart",
    "ModuleTruth",
    "RigFault",
    "RigFaults",
    "ServedRig",
    "SimulatedRig",
    "Truth",
    "run",
    "served_rig",
    "simulated_config",
    "simulated_rig",
]
MODULES = ("faults", "lines", "rig", "served", "truth")


def __getattr__(name: str) -> object:
    """Load what is named here on first use: pytest loads this package wherever ldcnd is installed."""
    if name in __all__:
        for module in MODULES:
            found = getattr(import_module(f"{__name__}.{module}"), name, None)
            if found is not None:
                return found
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
