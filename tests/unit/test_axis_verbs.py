"""What an axis can be asked to do has two enumerations, for the request and for the description; they are one list."""

from ldcnd.model.axes import Capability
from ldcnd.model.requests import Verb


def test_every_verb_of_an_axis_is_a_capability_and_the_other_way_round():
    assert [verb.value for verb in Verb] == [capability.value for capability in Capability]
