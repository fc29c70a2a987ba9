import pytest
from hypothesis import given
from hypothesis import strategies as st

from ldcnd.drivers.scaling import Scale


def test_a_reversed_axis_counts_backwards():
    scale = Scale(1000.0, reverse=True)

    assert scale.to_counts(2.5) == -2500
    assert scale.to_units(-2500) == 2.5


@given(st.floats(-1e6, 1e6), st.floats(1e-3, 1e6), st.booleans())
def test_units_survive_the_way_to_counts_and_back(value, counts_per_unit, reverse):
    scale = Scale(counts_per_unit, reverse=reverse)

    assert scale.to_units(scale.to_counts(value)) == pytest.approx(value, rel=1e-12, abs=1e-12)
