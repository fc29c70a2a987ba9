"""The load model of a large site: what it keeps to, and that the page about scale has its table."""

from dataclasses import replace

import pytest

from tests.bench.fleet_load import Costs, Site, demands, uses

SITE, COSTS = Site(), Costs()


def shares(site: Site, number: int) -> dict[str, float]:
    return {use.part: use.share for use in uses(site, COSTS, demands(site)[number])}


def test_what_nobody_takes_at_the_root_does_not_load_it() -> None:
    assert not {part for part in shares(SITE, 0) if "root" in part}


@pytest.mark.parametrize("number", range(1, len(demands(SITE))))
def test_twice_the_rigs_are_twice_the_load_at_the_root_and_no_more_at_an_edge(number: int) -> None:
    once, twice = shares(SITE, number), shares(replace(SITE, rigs=2 * SITE.rigs), number)

    for part, share in once.items():
        at_root = part in ("root router", "link of a client at the root", "client at the root")
        assert twice[part] == pytest.approx(share * (2 if at_root else 1))


def test_the_default_rates_are_what_an_axis_publishes() -> None:
    assert SITE.all_hz == 4 * (10 + 10 + 2 + 5 + 5)
