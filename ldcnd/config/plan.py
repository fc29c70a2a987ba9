"""From a configuration to the budgets of its lines, before anything is opened.

A plan that cannot hold is refused with the smallest changes that would make it hold, unless the line is configured to
skip polls. Computed with the longest replies and waits; see docs/explanation/timing.md for the analysis.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

from ldcnd.config.rig import RigConfig
from ldcnd.contract.errors import ConfigError, ValueOutOfRange
from ldcnd.contract.plan import BusPlan, ItemPlan, PollPlan, RigBudget
from ldcnd.drives.axis_config import AxisConfig
from ldcnd.drives.family import Demand
from ldcnd.drives.known import FAMILIES
from ldcnd.drives.line_config import BusConfig
from ldcnd.drives.line_plan import LinePlan, Poll, largest, plan_line

SLOWEST_HZ = 0.01


def plan_rig(config: RigConfig) -> RigBudget:
    """Plan every line."""
    buses = tuple(plan_bus(bus) for bus in config.bus)
    return RigBudget(rig=config.rig, holds=all(bus.holds for bus in buses), buses=buses)


def require_plan(config: RigConfig) -> RigBudget:
    """Return the plan of a rig.

    Raises:
        ConfigError: a line cannot carry its polls; says by how much, and which changes would make it fit.
    """
    plan = plan_rig(config)
    refused = [bus for bus in plan.buses if not bus.holds and bus.overload == "refuse"]
    if refused:
        raise ConfigError("\n".join(_refusal(bus) for bus in refused))
    return plan


def plan_bus(bus: BusConfig) -> BusPlan:
    """Plan one line."""
    demand = demand_of(bus)
    timing = demand.timing
    plan = plan_line(demand.polls, demand.urgent, by_deadline=demand.by_deadline, cycle=demand.cycle)
    return BusPlan(
        bus=bus.name,
        family=bus.family,
        baud=round(timing.host_baud),
        node_baud=timing.node_baud,
        turnaround_s=timing.turnaround_s,
        adapter_latency_s=timing.adapter_latency_s,
        **dict(plan.figures),
        stop_probe_hz=demand.stop_probe_hz,
        holds=plan.holds,
        overload="skip" if bus.skips else "refuse",
        remedies=() if plan.holds else tuple(_remedies(bus)),
        polls=tuple(_described(bus, plan)),
    )


def demand_of(bus: BusConfig) -> Demand:
    """Return the exchanges of a line; without probes if only they would make polls miss their turns."""
    demand = FAMILIES[bus.family].plan(bus)
    return demand.without_probes if not demand.fits and demand.without_probes.fits else demand


# -- what would make it fit ------------------------------------------------------------------------------------------


def _remedies(bus: BusConfig) -> list[str]:
    """Return changes of one setting each, any of which is enough."""
    demand, remedies = _bare(bus), []
    cap = largest(
        lambda hz: replace(demand, polls=_capped(demand.polls, hz)).fits,
        SLOWEST_HZ,
        max(poll.rate_hz for poll in demand.polls),
    )
    if cap is not None:
        shown = math.floor(cap * 100) / 100 if cap < 10 else math.floor(cap * 10) / 10  # noqa: PLR2004 - digits
        remedies.append(f"no rate above {shown:g} Hz")
    for baud in FAMILIES[bus.family].bauds:
        if baud > bus.baud and _fits_at(bus, baud):
            remedies.append(f"baud = {baud}")
            break
    if bus.adapter_latency_ms and _bare(bus.model_copy(update={"adapter_latency_ms": 0.0})).fits:
        remedies.append("adapter_latency_ms = 0, with an adapter that passes replies on at once")
    remedies.append('overload = "skip": polls then come as often as the line allows')
    return remedies


def _bare(bus: BusConfig) -> Demand:
    return FAMILIES[bus.family].plan(bus).without_probes


def _capped(polls: Sequence[Poll], most_hz: float) -> list[Poll]:
    return [replace(poll, rate_hz=min(poll.rate_hz, most_hz)) for poll in polls]


def _fits_at(bus: BusConfig, baud: int) -> bool:
    """Tell whether every drive of the line has this rate, and whether it is enough."""
    try:
        return _bare(type(bus).model_validate(bus.model_dump() | {"baud": baud})).fits
    except (ValueError, ValueOutOfRange):
        return False


# -- saying it -------------------------------------------------------------------------------------------------------


def _described(bus: BusConfig, plan: LinePlan) -> list[PollPlan]:
    axes = {axis.name: axis for axis in bus.axis}

    def address(poll: Poll) -> int:
        return axes[poll.axis].address if poll.address is None else poll.address

    return [
        PollPlan(
            axis=poll.axis,
            address=address(poll),
            request_bytes=poll.cost.request_bytes,
            reply_bytes=poll.cost.reply_bytes,
            rate_hz=poll.rate_hz,
            longest_s=poll.cost.longest_s,
            response_s=_bounded(response_s),
            holds=response_s <= poll.task.period_s,
            items=tuple(_items(axes.get(poll.axis), poll, response_s)),
            priority=axes[poll.axis].priority if poll.axis in axes else "normal",
        )
        for poll, response_s in zip(plan.polls, plan.responses_s, strict=True)
    ]


def _items(axis: AxisConfig | None, poll: Poll, response_s: float) -> list[ItemPlan]:
    """Slower items ride along with the nearest poll, so they may be due half a poll period before it."""
    if axis is None or len(poll.items) == 1:
        return [ItemPlan(item=poll.items[0], rate_hz=poll.rate_hz, response_s=_bounded(response_s))]
    riding_s = poll.task.period_s / 2
    return [
        ItemPlan(
            item=item.value,
            rate_hz=rate_hz,
            response_s=_bounded(response_s if rate_hz == poll.rate_hz else response_s + riding_s),
        )
        for item, rate_hz in axis.rates.wanted_hz(adc=True).items()
    ]


def _bounded(response_s: float) -> float | None:
    return None if math.isinf(response_s) else response_s


def _refusal(bus: BusPlan) -> str:
    late = ", ".join(poll.axis for poll in bus.polls if not poll.holds)
    return (
        f"bus {bus.bus}: at {bus.baud} baud the polls need {bus.load:.0%} of the line when drives are slow"
        f" ({bus.mean_load:.0%} on average), and those of {late} can miss their turns;"
        f" any of these is enough: {'; '.join(bus.remedies)}"
    )
