"""Whatever a host does, the simulated modules do something defined, and do it again with the same seed."""

import itertools

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ldcnd.drives.ldcn.packet import CommandCode, Packet, encode_packet
from ldcnd.sim.faults import FaultKind, FaultPlan, LineFault
from ldcnd.sim.ldcn.chain import MODELS, ChainSpec, ModuleSpec, build_chain

ALL_MODELS = tuple(ModuleSpec(name) for name in MODELS)
ADDRESSING = [
    encode_packet(Packet(0, CommandCode.SET_ADDRESS, bytes([address, 0xFF])))
    for address in range(1, len(ALL_MODELS) + 1)
]
commands = st.sampled_from(
    sorted(set(CommandCode) - {CommandCode.SET_BAUD_RATE, CommandCode.SET_ADDRESS, CommandCode.HARD_RESET})
)
packets = st.builds(
    lambda address, command, data: encode_packet(Packet(address, command, data)),
    st.sampled_from([0, 1, 2, 5, 7, 8, 9, 0xFF]),
    commands,
    st.binary(max_size=15),
)


def chain_of_all(**options):
    return build_chain(ChainSpec(ALL_MODELS, **options))


def play(chain, requests, gap_s=0.02):
    """Send requests at a steady pace; return everything that came back with its instants."""
    now_s, received = 0.0, []
    for request in [*ADDRESSING, *requests]:
        chain.write(now_s, request)
        now_s += gap_s
        received += chain.advance(now_s)
    return received


@settings(max_examples=60, deadline=None)
@given(noise=st.binary(min_size=1, max_size=200))
@pytest.mark.long
def test_any_bytes_are_survived(noise):
    chain = chain_of_all()

    play(chain, [noise])
    for module in chain.modules:
        module.power(on=False, at_s=2.0)
        module.power(on=True, at_s=3.0)

    chain.advance(4.0)
    replies = []
    for at, request in enumerate(ADDRESSING):
        chain.write(4.0 + at / 10, request)
        replies += chain.advance(4.1 + at / 10)
    assert len(replies) == len(ADDRESSING)


@settings(max_examples=60, deadline=None)
@given(requests=st.lists(packets, max_size=12))
@pytest.mark.long
def test_any_commands_with_any_data_are_answered_with_right_checksums(requests):
    received = play(chain_of_all(), requests)

    for _, reply in received:
        assert sum(reply[:-1]) & 0xFF == reply[-1]


@settings(max_examples=30, deadline=None)
@given(requests=st.lists(packets, max_size=10), seed=st.integers(0, 1000))
@pytest.mark.long
def test_same_seed_and_same_commands_give_the_same_bytes_at_the_same_instants(requests, seed):
    faults = tuple(LineFault(kind, 0.1, longest_s=0.02) for kind in FaultKind if kind is not FaultKind.UNPLUGGED)
    options = {"seed": seed, "faults": FaultPlan(faults, seed)}

    first = play(chain_of_all(**options), requests)
    second = play(chain_of_all(**options), requests)

    assert first == second


@settings(max_examples=30, deadline=None)
@given(requests=st.lists(packets, max_size=6), cuts=st.lists(st.integers(1, 18), max_size=6))
def test_how_a_request_is_cut_into_writes_does_not_matter(requests, cuts):
    whole, cut = chain_of_all(), chain_of_all()
    now_s = 0.0
    for request in [*ADDRESSING, *requests]:
        whole.write(now_s, request)
        edges = sorted({0, len(request), *(at for at in cuts if at < len(request))})
        for start, end in itertools.pairwise(edges):
            cut.write(now_s, request[start:end])
        now_s += 0.02

        received = whole.advance(now_s), cut.advance(now_s)

        assert [data for _, data in received[0]] == [data for _, data in received[1]]
