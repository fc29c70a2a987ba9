"""Which group address each module has."""

from ldcnd.drives.ldcn.group_plan import GroupPlan
from ldcnd.drives.line_config import GroupConfig

AXES = {1: "x", 2: "y", 3: "z", 5: "c"}
PLAN = GroupPlan((GroupConfig(name="pair", axes=("x", "z"), leader="z"),), AXES)


def test_members_of_a_group_share_an_address_and_the_others_have_that_of_everybody():
    assert [PLAN.place(address).address for address in (1, 2, 3, 5)] == [0x81, 0xFF, 0x81, 0xFF]
    assert PLAN.addresses == (0xFF, 0x81)


def test_a_module_that_is_no_axis_is_among_everybody():
    assert PLAN.place(4).address == 0xFF


def test_only_the_leader_leads():
    assert [PLAN.leads(address) for address in (1, 2, 3, 4, 5)] == [False, False, True, False, False]


def test_a_command_goes_to_a_group_only_when_it_concerns_all_of_it():
    pair, everybody = PLAN.exactly(frozenset({"x", "z"})), PLAN.exactly(frozenset({"y", "c"}))

    assert (pair.address, everybody.address) == (0x81, 0xFF)
    assert PLAN.exactly(frozenset({"x"})) is None
    assert PLAN.within(frozenset({"x", "z", "y"})) == (pair,)
    assert set(PLAN.within(frozenset(AXES.values()))) == {pair, everybody}


def test_without_groups_the_whole_line_is_one():
    plan = GroupPlan((), AXES)

    assert plan.addresses == (0xFF,)
    assert plan.exactly(frozenset(AXES.values())).address == 0xFF


def test_the_address_of_everybody_is_in_use_even_when_all_axes_are_grouped():
    plan = GroupPlan((GroupConfig(name="all", axes=tuple(AXES.values())),), AXES)

    assert plan.addresses == (0xFF, 0x81)
