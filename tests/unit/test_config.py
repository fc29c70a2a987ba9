import copy
import tomllib
from collections.abc import Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import pytest

from ldcnd.config.rig import RigConfig, load_config, single_line
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.units import Dimension

CONFIGURATIONS = Path(__file__).parents[2] / "config"

GOOD = """
rig = "bench"
[[bus]]
name = "a"
port = "/dev/ttyUSB0"
[[bus.axis]]
name = "x"
address = 1
model = "ls-182ap"
unit = "mm"
counts_per_unit = 1000
velocity = 10
acceleration = 100
"""


def load(tmp_path: Path, text: str):
    path = tmp_path / "rig.toml"
    path.write_text(text)
    return load_config(path)


def test_the_shipped_rigs_are_valid():
    for path in Path("config").glob("*.toml"):
        assert load_config(path).bus


def test_a_good_file_loads(tmp_path):
    rig = load(tmp_path, GOOD)

    assert rig.bus[0].axis[0].counts_per_unit == 1000
    assert rig.bus[0].baud == 19_200


def test_an_axis_without_a_scale_works_in_counts(tmp_path):
    rig = load(tmp_path, GOOD.replace('unit = "mm"\ncounts_per_unit = 1000\n', ""))

    assert rig.bus[0].axis[0].unit == "count"
    assert rig.bus[0].axis[0].counts_per_unit is None
    assert rig.bus[0].axis[0].signed_counts_per_unit == 1


@pytest.mark.parametrize("written", ["10000/360", "70000/1080"])
def test_a_scale_that_is_a_ratio_stays_one_where_the_configuration_is_written_again(tmp_path, written):
    rig = load(tmp_path, GOOD.replace("counts_per_unit = 1000", f'counts_per_unit = "{written}"\nmodulo = 360'))
    again = RigConfig.model_validate_json(rig.model_dump_json())
    (axis,) = again.bus[0].axis

    assert again == rig
    assert axis.model_dump()["counts_per_unit"] == written
    assert axis.signed_counts_per_unit == float(Fraction(written))
    assert axis.unit_table[Dimension.POSITION]["count"] == str(1 / Fraction(written))


def test_a_reversed_axis_counts_backwards(tmp_path):
    rig = load(tmp_path, GOOD.replace("acceleration = 100", 'acceleration = 100\ndirection = "reverse"'))

    assert rig.bus[0].axis[0].signed_counts_per_unit == -1000


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("address = 1", "address = 200"), ["bus[0].axis[0].address", "127", "200"]),
        (('model = "ls-182ap"', 'model = "ls-999"'), ["bus[0].axis[0].model", "ls-999", "pic-servo-v4"]),
        (('port = "/dev/ttyUSB0"', 'port = "COM3"'), ["bus[0].port", "COM3", "socket://"]),
        (('port = "/dev/ttyUSB0"', 'port = "sim:z"'), ["sim:z", "[[sim]]"]),
        (("counts_per_unit = 1000", ""), ["bus[0].axis[0]", "counts_per_unit"]),
        (("counts_per_unit = 1000", "counts_per_unit = 0"), ["counts_per_unit", "or equal to 0.000000001"]),
        (("counts_per_unit = 1000", "counts_per_unit = 1e-300"), ["counts_per_unit", "or equal to 0.000000001"]),
        (("counts_per_unit = 1000", "counts_per_unit = 1e300"), ["counts_per_unit", "less than or equal to"]),
        (("counts_per_unit = 1000", 'counts_per_unit = "1/0"'), ["counts_per_unit", "'1/0' is not a ratio above 0"]),
        (
            ("counts_per_unit = 1000", "counts_per_unit = 27.7778\nmodulo = 360"),
            ["is 10000.008 encoder", '"10000/360"'],
        ),
        (("velocity = 10", "velocity = inf"), ["velocity", "finite"]),
        (("velocity = 10", "velocity = nan"), ["velocity"]),
        (('rig = "bench"', 'rig = "Bench 1"'), ["rig", "Bench 1"]),
        (('rig = "bench"', 'rigg = "bench"'), ["rigg", "rig"]),
        (('port = "/dev/ttyUSB0"', 'port = "/dev/ttyUSB0"\nbaud = 4800'), ["bus[0]: baud", "4800", "19200"]),
        (
            ("acceleration = 100", "acceleration = 100\nlimits = { position_min = 5, position_max = 5 }"),
            ["bus[0].axis[0]", "position_min 5"],
        ),
        (
            ("acceleration = 100", "acceleration = 100\nlimits = { velocity = 1 }"),
            ["velocity 10 mm/s", "limits.velocity 1 mm/s"],
        ),
        (
            ("acceleration = 100", 'acceleration = 100\nhome = { method = "index", velocity = 0 }'),
            ["home.velocity is 0"],
        ),
        (
            (
                "acceleration = 100",
                'acceleration = 100\nlimits = { velocity = 20 }\nhome = { method = "index", velocity = -30 }',
            ),
            ["home.velocity 30", "limits.velocity 20"],
        ),
    ],
)
def test_a_wrong_value_names_file_key_value_and_what_is_allowed(tmp_path, change, words):
    with pytest.raises(ConfigError) as error:
        load(tmp_path, GOOD.replace(*change))

    assert "rig.toml" in error.value.message
    for word in words:
        assert word in error.value.message


def test_two_axes_of_one_name_are_refused(tmp_path):
    axis = GOOD[GOOD.index("[[bus.axis]]") :]

    with pytest.raises(ConfigError, match="'x' is given more than once"):
        load(tmp_path, GOOD + axis.replace("address = 1", "address = 2"))


def test_two_axes_on_one_address_are_refused(tmp_path):
    axis = GOOD[GOOD.index("[[bus.axis]]") :]

    with pytest.raises(ConfigError, match="address 1"):
        load(tmp_path, GOOD + axis.replace('"x"', '"y"'))


def test_a_file_that_is_not_toml_or_not_there_says_so(tmp_path):
    with pytest.raises(ConfigError, match="not valid TOML"):
        load(tmp_path, "rig = ")
    with pytest.raises(ConfigError, match="cannot be read"):
        load_config(tmp_path / "nothing.toml")


def test_all_complaints_come_at_once(tmp_path):
    with pytest.raises(ConfigError) as error:
        load(tmp_path, GOOD.replace("address = 1", "address = 0").replace("acceleration = 100", "acceleration = -1"))

    assert len(error.value.message.splitlines()) == 2


TWO_LINES = (
    'state_dir = "/var/lib/ldcnd"\n'
    + GOOD
    + GOOD.replace('rig = "bench"', "")
    .replace('name = "a"', 'name = "b"')
    .replace('name = "x"', 'name = "y"')
    .replace("USB0", "USB1")
)


def test_lines_that_are_served_by_processes_of_their_own_share_no_key_and_no_file(tmp_path):
    rig = load(tmp_path, TWO_LINES)

    a, b = (single_line(rig, name) for name in "ab")

    assert [[bus.name for bus in line.bus] for line in (a, b)] == [["a"], ["b"]]
    assert (a.rig, b.rig) == ("bench_a", "bench_b")
    assert (a.state_dir, b.state_dir) == (Path("/var/lib/ldcnd/a"), Path("/var/lib/ldcnd/b"))


def test_a_line_that_is_not_there_cannot_be_served_alone(tmp_path):
    with pytest.raises(ConfigError, match="rig bench has no bus 'c'"):
        single_line(load(tmp_path, TWO_LINES), "c")


def test_the_name_of_a_line_that_is_served_alone_must_fit_into_a_key(tmp_path):
    rig = load(tmp_path, TWO_LINES.replace("bench", "b" * 63))

    with pytest.raises(ConfigError, match="too long"):
        single_line(rig, "a")


OF_A = """
[[interlock]]
name = "homed"
of = "x"
requires = [{ axis = "x", homed = true }]
[[position]]
name = "park"
axes = { x = 1 }
[[sequence]]
name = "parks"
step = [{ go = "park", standstill = ["x"] }]
[[port]]
name = "old"
bus = "a"
link = "/tmp/old"
[heartbeat]
file = "/tmp/level"
lines = ["a"]
"""


def test_a_line_that_is_served_alone_keeps_its_own_parts_and_none_of_another_line(tmp_path):
    rig = load(tmp_path, TWO_LINES + OF_A)

    a, b = (single_line(rig, name) for name in "ab")

    of_lines = [(each.interlock, each.position, each.sequence, each.port, each.heartbeat) for each in (a, b)]
    assert of_lines == [
        (rig.interlock, rig.position, rig.sequence, rig.port, rig.heartbeat),
        ((), (), (), (), None),
    ]


def test_a_position_or_sequence_of_two_lines_is_no_part_of_one_that_is_served_alone(tmp_path):
    place = '[[position]]\nname = "park"\naxes = { x = 1, y = 2 }\n'
    parks = '[[sequence]]\nname = "parks"\nstep = [{ do = "halt", axis = "x", standstill = ["y"] }]'
    a, b = (single_line(load(tmp_path, TWO_LINES + place + parks), name) for name in "ab")

    assert [each.position + each.sequence for each in (a, b)] == [(), ()]


@pytest.mark.parametrize(
    ("crossing", "said"),
    [
        (
            '[[interlock]]\nname = "apart"\nof = "x"\nrequires = [{ axis = "y", standstill = true }]',
            "interlock apart needs a and b",
        ),
        ('[heartbeat]\nfile = "/tmp/level"', "heartbeat needs a and b"),
        ('[heartbeat]\nfile = "/tmp/level"\nlines = ["a", "b"]', "heartbeat needs a and b"),
    ],
)
@pytest.mark.parametrize("line", ["a", "b"])
def test_what_needs_two_lines_keeps_each_of_them_from_being_served_alone(tmp_path, line, crossing, said):
    rig = load(tmp_path, TWO_LINES + crossing)

    with pytest.raises(ConfigError, match=f"line {line} cannot be served by itself: {said}"):
        single_line(rig, line)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ('address = 1\nmodle = "x"', r"bus\[0\].axis\[0\].modle: there is no such key; did you mean 'model'\?"),
        ("address = 1\nzzz = 1", r"bus\[0\].axis\[0\].zzz: there is no such key$"),
        ("address = 1\n[bus.axis.rates]\nidle = 2", r"rates.idle: no longer supported: .* delete this key"),
    ],
)
def test_an_unknown_key_names_the_one_that_may_be_meant_and_a_removed_one_says_so(tmp_path, change, words):
    text = GOOD.replace("counts_per_unit = 1000\n", "").replace('unit = "mm"\n', "")
    text = text.replace("velocity = 10\nacceleration = 100\n", "").replace('model = "ls-182ap"\n', "")
    text = text.replace("address = 1", 'model = "ls-182ap"\nvelocity = 10\nacceleration = 100\n' + change)

    with pytest.raises(ConfigError, match=words):
        load(tmp_path, text)


@pytest.mark.parametrize(
    "path", sorted((Path(__file__).parents[2] / "config").glob("*.toml")), ids=lambda path: path.name
)
def test_configuration_that_a_capture_carries_is_the_one_that_was_read(path):
    config = load_config(path)

    carried = config.model_dump(mode="json", exclude_defaults=True)

    assert RigConfig.model_validate(carried) == config


ODD: tuple[object, ...] = (["x", "y"], [], {"a": 1}, [{"a": [1]}], "x", True, -1, 1e308, 10**30)
"""What may stand where something else is meant."""


def places_in(value: object) -> Iterator[tuple[dict[str, Any] | list[Any], str | int]]:
    """Yield every place of a document, as what holds it and where in there."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, each in inner:
        yield value, key
        yield from places_in(each)


@pytest.mark.parametrize("name", ["centrifuge", "mixed"])
@pytest.mark.sweep(2)
def test_whatever_stands_where_something_else_is_meant_is_a_complaint_and_nothing_else(name, tmp_path, monkeypatch):
    path = CONFIGURATIONS / f"{name}.toml"
    document = tomllib.loads(path.read_text())
    monkeypatch.setattr("ldcnd.drives.toml.tomllib.loads", lambda _text: copy.deepcopy(document))
    refused = 0
    for holder, key in list(places_in(document)):
        meant = holder[key]
        for odd in ODD:
            holder[key] = odd
            try:
                load_config(path)
            except ConfigError:
                refused += 1
        holder[key] = meant

    assert refused > 800


@pytest.mark.parametrize("text", [f"rig = {'1' * 5000}", f"rig = {'[' * 5000}{']' * 5000}"])
def test_a_file_that_no_reader_takes_is_a_complaint(text, tmp_path):
    with pytest.raises(ConfigError, match="not valid TOML"):
        load(tmp_path, text)
