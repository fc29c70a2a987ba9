"""Numbers that EPICS clients put as texts: `caput` does when it is told to."""

import pytest

from ldcnd.lab.epics.fields import Put, choice, number, string


@pytest.mark.parametrize(("text", "value"), [("1.5", 1.5), ("1,5", 1.5), (b"-2 mm", -2.0), (3, 3), (0.25, 0.25)])
async def test_a_text_is_taken_as_the_number_that_it_stands_for(text, value):
    taken = []

    async def take(given):
        taken.append(given)
        return Put()

    field = number(unit="mm")
    field.action = take
    await field.write(text)

    assert taken == [value]


@pytest.mark.parametrize(
    "text", ["1_000", "1,234", "nan", "inf", "\uff11", "0x10", "2 um", "", float("nan"), float("inf")]
)
async def test_what_is_no_number_is_a_failed_put(text):
    async def take(given):
        raise AssertionError(given)

    field = number(unit="mm")
    field.action = take
    with pytest.raises(ValueError, match=r"number|unit|digits|missing|can mean"):
        await field.write(text)


@pytest.mark.parametrize(
    "field", [number(), choice("Go", "Stop", "Go"), string()], ids=lambda field: type(field).__name__
)
async def test_a_put_that_names_no_value_is_none_of_0(field):
    async def take(given):
        raise AssertionError(given)

    field.action = take
    with pytest.raises(ValueError, match="names no value"):
        await field.write(None)
