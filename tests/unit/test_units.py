"""Units: what is taken for an axis, and what it becomes on the network, from configuration to console."""

import math
from pathlib import Path

import pytest

from ldcnd.config.rig import load_config
from ldcnd.contract.commands import COMMANDS
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.number_text import NotANumber
from ldcnd.contract.units import (
    DIMENSIONS,
    AxisUnits,
    Dimension,
    g_velocity,
    quantity_text,
    read_quantity,
    unit_table,
    units_of,
)
from tests.support.console_parts import ask_the_pages, part_of_pages
from tests.unit.test_number_text import ROOT

_TABLE = unit_table("rev", 8000, "rpm", "rpm/s", {"third": "1/3"})
ROTOR = AxisUnits("rev", _TABLE, g_velocity(_TABLE, 0.1))
SLIDE = AxisUnits("mm", unit_table("mm", 1000, None, None, {}))
PLAIN = AxisUnits("count", unit_table("count", None, None, None, {}))
CASES = [
    (ROTOR, "velocity", "3000 rpm", 50.0),
    (ROTOR, "velocity", "3000", 50.0),
    (ROTOR, "velocity", "50 rev/s", 50.0),
    (ROTOR, "velocity", "-360 deg / s", -1.0),
    (ROTOR, "velocity", "1 third/min", 1 / 180),
    (ROTOR, "acceleration", "600 rpm/s", 10.0),
    (ROTOR, "acceleration", "10 rev/s²", 10.0),
    (ROTOR, "position", "90 °", 0.25),
    (ROTOR, "position", "0,1", 0.1),
    (ROTOR, "position", "3 third", 1.0),
    (ROTOR, "position", "4000 count", 0.5),
    (SLIDE, "position", "1 in", 25.4),
    (SLIDE, "position", "250 µm", 0.25),
    (SLIDE, "position", "250 um", 0.25),
    (SLIDE, "velocity", "6 m/min", 100.0),
    (SLIDE, "acceleration", "1 g", 9806.65),
    (PLAIN, "velocity", "5 count/s", 5.0),
]
REFUSED = [
    (ROTOR, "velocity", "3000 mm/s", "or g"),
    (ROTOR, "velocity", "90 deg", "rpm, rev/s"),
    (ROTOR, "position", "5 mm", "rev, deg"),
    (SLIDE, "velocity", "100 g", "mm/s"),
    (SLIDE, "acceleration", "5 rev/s2", "mm/s2"),
    (PLAIN, "position", "5 mm", "which is count"),
    (ROTOR, "velocity", "1,234 rpm", "1.234 or 1234"),
]


@pytest.mark.parametrize(("axis", "dimension", "text", "value"), CASES)
def test_a_number_with_a_unit_is_exact_in_the_unit_of_the_axis(axis, dimension, text, value):
    assert read_quantity(text, axis, Dimension(dimension)) == value


@pytest.mark.parametrize(("axis", "dimension", "text", "said"), REFUSED)
def test_a_unit_that_does_not_fit_is_refused_with_those_that_do(axis, dimension, text, said):
    with pytest.raises(NotANumber) as refused:
        read_quantity(text, axis, Dimension(dimension))

    assert said in str(refused.value)


def test_g_is_the_acceleration_at_the_radius():
    velocity = read_quantity("1000 g", ROTOR, Dimension.VELOCITY)

    assert (velocity * math.tau) ** 2 * 0.1 == pytest.approx(9806.65)
    assert read_quantity("-1000 g", ROTOR, Dimension.VELOCITY) == -velocity
    assert quantity_text(velocity, ROTOR, Dimension.VELOCITY) == "2990 rpm (1000 g)"


@pytest.mark.parametrize("axis", [ROTOR, SLIDE, PLAIN])
@pytest.mark.parametrize("dimension", Dimension)
def test_what_is_shown_is_read_back_as_the_same(axis, dimension):
    for unit in units_of(axis, dimension):
        value = read_quantity(f"12.5 {unit}", axis, dimension)
        shown = quantity_text(value, axis, dimension, ".17g").partition(" (")[0]
        assert read_quantity(shown, axis, dimension) == pytest.approx(value, rel=1e-15)


ASK_THE_PAGES = """
const [reader, cases] = JSON.parse(require("fs").readFileSync(0, "utf8"));
const module = `data:text/javascript;base64,${Buffer.from(reader).toString("base64")}`;
import(module).then(({ readNumber, unitsOf, Unread }) => {
  const out = cases.map(([info, dimension, text]) => readNumber(text, { units: unitsOf(info, dimension) }));
  console.log(JSON.stringify(out.map((each) => (each instanceof Unread ? each.message : each))));
});
"""


@pytest.mark.parametrize(
    ("text", "same"),
    [
        ("1000 RPM", "1000 rpm"),
        ("1000Rpm", "1000 rpm"),
        ("1000 x g", "1000 g"),
        ("1000 xg", "1000 g"),
        ("20 \u00d7 g", "20 g"),
    ],
)
def test_units_of_a_centrifuge_are_taken_as_people_write_them(text, same):
    taken = [read_quantity(each, ROTOR, Dimension.VELOCITY) for each in (text, same)]

    assert taken[0] == taken[1]


def test_pages_convert_as_the_command_line_does():
    asked, expected = [], []
    more = [(ROTOR, "velocity", "1000 g", 0), (ROTOR, "velocity", "1e308 rev/s", 0)]
    for axis, dimension, text, _ in [*CASES, *REFUSED, *more]:
        info = {"unit": axis.unit, "units": axis.units, "g_velocity": axis.g_velocity}
        asked.append([info, dimension, text])
        try:
            expected.append(pytest.approx(read_quantity(text, axis, Dimension(dimension)), rel=1e-15))
        except NotANumber as error:
            expected.append(str(error))

    assert ask_the_pages(ASK_THE_PAGES, part_of_pages("number_text.js"), asked) == expected


def _axis_of(tmp_path: Path, *changes: tuple[str, str]):
    text = (ROOT / "config" / "centrifuge.toml").read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    path = tmp_path / "rig.toml"
    path.write_text(text, encoding="utf-8")
    return load_config(path)


UNIT = 'unit = "rev"\n'


def test_a_configuration_says_numbers_with_their_units(tmp_path):
    rig = _axis_of(
        tmp_path,
        ("limits = { velocity = 3300, acceleration = 10 }", 'limits = { velocity = "55 rev/s", acceleration = 10 }'),
        ("window = 0.002", 'window = "0.72 deg"'),
        ("above = 120", 'above = "2 rev/s"'),
    )
    axis = rig.bus[0].axis[0]

    assert (axis.velocity, axis.acceleration, axis.limits.velocity, axis.settle.window) == (0.5, 1, 55, 0.002)
    assert axis.home.velocity == 0.3  # without a unit, it is in the one that is shown
    assert {each.name: each.above for each in rig.interlock}["balance"] == 2
    assert {each.below for rule in rig.interlock for each in rule.requires if each.below} == {0.1}


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("velocity = 30 ", 'velocity = "3 mm/s" ', "bus[0].axis[0].velocity: \u201cmm/s\u201d is not a unit here"),
        ('velocity_unit = "rpm"', 'velocity_unit = "mm/s"', "'mm/s' does not fit: it is one of rev/s, deg/s"),
        (UNIT, 'unit = "rev"\nunits = { deg = "1/3" }\n', "units: 'deg' is the name of another unit"),
        (UNIT, 'unit = "rev"\nunits = { "a/s" = "1/3" }\n', "units: 'a/s' is the name of another unit"),
        (UNIT, 'unit = "rev"\nunits = { third = "1/0" }\n', "'1/0' is not a ratio above 0"),
        ('unit = "rev"\nvelocity_unit = "rpm"', 'unit = "mm"', "only an axis that turns has one"),
        ("above = 120", 'above = "2 m"', "interlock[1].above: \u201cm\u201d is not a unit here"),
    ],
)
def test_a_unit_that_does_not_fit_is_refused_where_it_stands(tmp_path, old, new, said):
    with pytest.raises(ConfigError) as refused:
        _axis_of(tmp_path, (old, new))

    assert said in refused.value.message


def test_each_number_of_a_command_that_is_no_time_and_no_share_has_a_dimension():
    floats = {
        f"{command.__name__}.{name}"
        for command in COMMANDS
        for name, field in command.model_fields.items()
        if float in getattr(field.annotation, "__args__", (field.annotation,))
        and not (name in DIMENSIONS or name.endswith("_s") or name == "duty")
    }
    assert not floats, "typed with a unit they would be plain numbers"


@pytest.mark.parametrize("dimension", list(Dimension))
def test_the_largest_numbers_have_a_text(dimension):
    """A refusal names the number that it refuses."""
    assert all(quantity_text(sign * 1.7e308, ROTOR, dimension) for sign in (1, -1))
