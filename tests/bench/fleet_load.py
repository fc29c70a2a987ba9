"""What a site of many rigs asks of its daemons, routers, links and clients: a calculated model, no measurement.

Run as `python -m tests.bench.fleet_load`. Rigs hang on edge routers, edge routers on one root. Steady traffic only,
every sample at the cost that `tests.bench.sample_cost` has measured; bursts, queries and losses are not modelled.
"""

import argparse
from collections.abc import Iterator
from dataclasses import dataclass

from ldcnd.drives.axis_config import RatesConfig

BITS = 8
DEFAULT_RATES = RatesConfig()
HEALTH_HZ = 2.0
"""Reports of a rig with one line."""


@dataclass(frozen=True, slots=True)
class Costs:
    """Processor time of one sample, in us, and its bytes on a link; as measured for docs/explanation/scale.md."""

    daemon_us: float = 29.0
    router_in_us: float = 8.5
    router_out_us: float = 0.9
    client_us: float = 55.0
    wire_bytes: float = 178.0


@dataclass(frozen=True, slots=True)
class Site:
    """Its shape; the rates are the defaults of the configuration.

    Attributes:
        rigs: all of them.
        rigs_per_edge: behind one edge router.
        axes: of each rig.
        rates: of each axis.
        rig_link_bps: between a rig and its router.
        trunk_bps: between routers, and to whoever sits at the root.
        router_cores: how many cores a router can use.
    """

    rigs: int = 1000
    rigs_per_edge: int = 40
    axes: int = 4
    rates: RatesConfig = DEFAULT_RATES
    rig_link_bps: float = 100e6
    trunk_bps: float = 1e9
    router_cores: float = 2.0

    @property
    def all_hz(self) -> float:
        """Samples of one rig: state and faults go out together."""
        rates = self.rates
        return self.axes * (rates.position + rates.velocity + rates.adc + 2 * rates.state)

    @property
    def state_hz(self) -> float:
        """States and faults of one rig."""
        return self.axes * 2 * self.rates.state

    @property
    def items(self) -> int:
        """Telemetry keys of one rig."""
        return self.axes * 5


@dataclass(frozen=True, slots=True)
class Demand:
    """Who takes what.

    Attributes:
        name: what it is called in the table.
        published_hz: what a rig publishes for it.
        local: subscribers at the rig's own edge router, to all that it publishes.
        to_root_hz: what an edge router passes on, for each of its rigs.
        at_root: subscribers at the root, to all that gets there.
        answer: the setting that makes it so.
    """

    name: str
    published_hz: float
    local: float
    to_root_hz: float
    at_root: int
    answer: str


@dataclass(frozen=True, slots=True)
class Use:
    """How full one part of the site is.

    Attributes:
        part: which.
        share: 1 is full.
        grows: it is shared by all rigs of the site, so that more rigs fill it.
    """

    part: str
    share: float
    grows: bool


def demands(site: Site) -> tuple[Demand, ...]:
    """Return what the table compares."""
    everything, states, once_a_second = site.all_hz, site.state_hz, float(site.items)
    return (
        Demand(
            "each rig is watched at its own edge",
            everything,
            1,
            0.0,
            0,
            "nothing: samples without subscribers stay away",
        ),
        Demand("one recorder of everything at the root", everything, 0, everything, 1, "-"),
        Demand("the same, and three displays of everything", everything, 0, everything, 4, "-"),
        Demand("states and faults at the root", states, 0, states, 1, "a narrower subscription"),
        Demand(
            "once a second at the root", everything, 0, once_a_second, 1, "`downsampling` at the edge, a rule a key"
        ),
        Demand("health at the root", HEALTH_HZ, 0, HEALTH_HZ, 1, "subscribe to `ldcn/*/meta/health/**`"),
        Demand("a recorder at each edge, health at the root", everything, 1, HEALTH_HZ, 1, "a storage for each region"),
    )


def uses(site: Site, costs: Costs, demand: Demand) -> Iterator[Use]:
    """Yield how full each kind of node and link is; edges and rigs are all alike."""
    edge_in_hz = site.rigs_per_edge * demand.published_hz
    edge_out_hz = site.rigs_per_edge * (demand.published_hz * demand.local + demand.to_root_hz)
    root_hz = site.rigs * demand.to_root_hz
    frame_bits = costs.wire_bytes * BITS
    router_us = 1e6 * site.router_cores
    yield Use("daemon", demand.published_hz * costs.daemon_us / 1e6, grows=False)
    yield Use("link of a rig", demand.published_hz * frame_bits / site.rig_link_bps, grows=False)
    yield Use(
        "edge router", (edge_in_hz * costs.router_in_us + edge_out_hz * costs.router_out_us) / router_us, grows=False
    )
    if demand.local:
        yield Use("client at an edge", edge_in_hz * costs.client_us / 1e6 / _clients(site, demand), grows=False)
    if not root_hz:
        return
    yield Use(
        "link from edge to root", site.rigs_per_edge * demand.to_root_hz * frame_bits / site.trunk_bps, grows=False
    )
    root_us = root_hz * (costs.router_in_us + demand.at_root * costs.router_out_us)
    yield Use("root router", root_us / router_us, grows=True)
    yield Use("link of a client at the root", root_hz * frame_bits / site.trunk_bps, grows=True)
    yield Use("client at the root", root_hz * costs.client_us / 1e6, grows=True)


def _clients(site: Site, demand: Demand) -> int:
    """Return among how many programs the subscribers of an edge share its rigs: viewers have one rig each."""
    return 1 if demand.at_root else site.rigs_per_edge


def as_markdown(site: Site, costs: Costs) -> str:
    """Return the model as a table: what is busiest, what is next, and how many rigs it would take to fill it."""
    lines = [
        "| who takes what | samples/s at the root | busiest | next | full with | setting |",
        "|---|---|---|---|---|---|",
    ]
    for demand in demands(site):
        first, second = sorted(uses(site, costs, demand), key=lambda use: -use.share)[:2]
        growing = max((use.share for use in uses(site, costs, demand) if use.grows), default=0.0)
        rigs = f"{site.rigs / growing:.0f} rigs" if growing else "any number"
        lines.append(
            f"| {demand.name} | {site.rigs * demand.to_root_hz:.0f} | {_shown(first)} | {_shown(second)} | {rigs}"
            f" | {demand.answer} |"
        )
    return "\n".join(lines) + "\n"


def _shown(use: Use) -> str:
    return f"{use.part} {use.share:.1%}" if use.share < 1 else f"**{use.part} {use.share:.1f} x**"


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__).parse_args()
    print(as_markdown(Site(), Costs()))
