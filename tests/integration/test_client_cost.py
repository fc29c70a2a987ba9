"""What a typed sample may cost: at most twice a bare subscriber that unpacks msgpack, in the same run."""

import pytest

from tests.bench.client_sample import costs


@pytest.mark.real_time
@pytest.mark.soak
async def test_a_typed_sample_costs_at_most_twice_a_bare_one():
    found = await costs((100, 500, 2000))

    print(found)
    assert max(cost.ratio for cost in found) <= 2.0
