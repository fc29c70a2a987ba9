"""Whatever a host in the field did to a chain, and however their bytes were cut, a clean host can take it over."""

import asyncio
import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.testing.jumping_loop import JumpingLoop
from tests.support import rough_host as rough
from tests.support.clean_host import bring_up

CHAINS = (
    ("ls182ap", "picio", "picservo-v4"),
    ("picservo-sc", "ls182ap", "picio", "ls173ap"),
    ("picio", "picservo-v1", "picservo-v4", "picstep"),
)
addresses = st.integers(1, 4)
absent = st.integers(20, 120)
bauds = st.sampled_from(sorted(rough.BAUD_CODES))
frames = st.one_of(
    st.builds(lambda address, extra: rough.frame(address, 0xE, *extra), addresses, st.binary(max_size=15)),
    st.builds(lambda address, extra: rough.frame(address, 0xD, 0x05, *extra), addresses, st.binary(max_size=14)),
    st.builds(lambda address, command: rough.frame(address, command, 0x01), absent, st.sampled_from([0x3, 0x5, 0x7])),
    st.builds(lambda address, control: rough.frame(address, 0x7, control), addresses, st.sampled_from([1, 4, 5, 9])),
    st.builds(lambda address, control: rough.frame(address, 0x9, control), addresses, st.sampled_from([0, 8, 0x13])),
)
deeds = st.one_of(
    st.builds(rough.padded, st.lists(frames, min_size=1, max_size=3), st.integers(0, 20)),
    st.builds(rough.burst, st.lists(frames, min_size=1, max_size=12), bauds),
    st.builds(rough.hard_reset, st.sampled_from([0.0001, 0.003, 2.0]), bauds),
    st.builds(rough.enumeration, st.integers(1, 4), bauds),
    st.builds(rough.individual_baud_and_back, addresses, bauds),
    st.builds(rough.new_address, addresses, st.integers(1, 32)),
    st.builds(rough.jog, addresses),
    st.builds(rough.powered, addresses),
    st.builds(rough.sweep, bauds),
    st.just(rough.probing()),
)
cuts = st.lists(
    st.tuples(st.integers(1, 40), st.sampled_from([0.0, 0.0001, 0.001, 0.02])),
    min_size=1,
    max_size=8,
)


def report_after(names, story, cuts, seed=1, attempts=1):
    """Let a rough host play a story on a chain, then bring the chain up."""

    async def scenario():
        chain = build_chain(ChainSpec(tuple(map(ModuleSpec, names)), seed=seed))
        host = await rough.rough_host(chain)
        await host.do(rough.enumeration(len(names)), itertools.repeat((100, 0.0)))
        await host.do(rough.powered(1), itertools.repeat((100, 0.0)))
        await host.do(itertools.chain.from_iterable(story), itertools.cycle(cuts))
        await host.leave()
        return await bring_up(chain, attempts=attempts)

    with asyncio.Runner(loop_factory=JumpingLoop) as runner:
        return runner.run(scenario())


@pytest.mark.parametrize("names", CHAINS, ids="+".join)
@settings(max_examples=20, deadline=None)
@given(story=st.lists(deeds, max_size=6), cuts=cuts, seed=st.integers(0, 1000))
@pytest.mark.sweep(3)
def test_a_clean_host_initialises_after_any_rough_one(names, story, cuts, seed):
    report = report_after(names, story, cuts, seed)

    assert report.reset
    assert report.baud == 115_200


@pytest.mark.parametrize("names", CHAINS, ids="+".join)
@settings(max_examples=20, deadline=None)
@given(
    story=st.lists(st.one_of(deeds, st.builds(rough.individual_baud, addresses, bauds)), max_size=6),
    cuts=cuts,
    seed=st.integers(0, 1000),
)
@pytest.mark.sweep(2)
def test_a_chain_split_by_a_reset_at_one_of_its_rates_comes_up_in_three_attempts(names, story, cuts, seed):
    report = report_after(names, story, cuts, seed, attempts=3)

    assert report.reset


@pytest.mark.parametrize("baud", [9600, 57_600, 115_200])
def test_a_clean_host_initialises_a_chain_whose_first_module_is_at_a_rate_of_its_own(baud):
    report = report_after(CHAINS[0], [rough.individual_baud(1, baud)], [(100, 0.0)])

    assert report.reset
