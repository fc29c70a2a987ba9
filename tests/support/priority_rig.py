"""Lines whose axes have priorities, and what each axis is granted of what it asks for."""

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass

from ldcnd.config.rig import RigConfig
from ldcnd.contract.codec import decode
from ldcnd.contract.health import AxisHealth, BusHealth
from ldcnd.contract.plan import PollPriority
from tests.support.rig import RunningRig


@dataclass(frozen=True, slots=True)
class Asked:
    """Axes of one priority.

    Attributes:
        axes: how many.
        hz: how often each is asked for everything.
    """

    axes: int
    hz: float


def ranked_config(asked: Mapping[PollPriority, Asked], **bus: object) -> RigConfig:
    """Return a rig of LS-182AP drives on one simulated line, named after their priorities and addresses."""
    axes: list[dict[str, object]] = []
    for priority, each in asked.items():
        for _ in range(each.axes):
            address = len(axes) + 1
            axis = {"name": f"{priority}{address}", "address": address, "model": "ls-182ap", "priority": priority}
            rates = dict.fromkeys(("position", "velocity", "adc", "state"), each.hz)
            axes.append({**axis, "velocity": 1.0, "acceleration": 1.0, "rates": rates})
    line = {"name": "line0", "port": "sim:line0", "baud": 115_200, "adapter_latency_ms": 0.0, "overload": "skip"}
    sim = {"name": "line0", "module": [{"model": "ls182ap"}] * len(axes)}
    return RigConfig.model_validate({"rig": "sim", "bus": [{**line, **bus, "axis": axes}], "sim": [sim]})


@dataclass(frozen=True, slots=True)
class Granted:
    """Which share of the positions that each axis asked for came."""

    shares: Mapping[str, float]

    def of(self, priority: PollPriority) -> list[float]:
        """Return the shares of all axes of a priority, least first."""
        return sorted(share for axis, share in self.shares.items() if axis.startswith(priority))


async def granted(rig: RunningRig, seconds: int) -> Granted:
    """Listen to so many health reports."""
    axes: dict[str, list[AxisHealth]] = {}
    for _ in range(seconds):
        await asyncio.sleep(1.0)
        (answer,) = await rig.session.query("ldcn/sim/meta/health/line0")
        for axis in decode(BusHealth, answer.payload, answer.encoding).axes:
            axes.setdefault(axis.axis, []).append(axis)
    return Granted({name: _share(reports) for name, reports in axes.items()})


def _share(reports: list[AxisHealth]) -> float:
    positions = [item for report in reports for item in report.items if item.item == "position"]
    return sum(item.granted_hz for item in positions) / sum(item.asked_hz for item in positions)
