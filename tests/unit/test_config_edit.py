"""Settings of one axis are written into a configuration; nothing else of the file changes."""

import pytest

from ldcnd.bench.edit import edited_for_axis, set_for_axis
from ldcnd.config.rig import load_config
from ldcnd.contract.errors import ConfigError
from tests.support.process import ROOT

MIXED = (ROOT / "config" / "mixed.toml").read_text()
BITS = {"trace1": "0x0000", "trace2": "0x0010", "io": "0x0020", "rising": "0x4000", "falling": "0x8000"}
LAYOUT = {
    "smartstep": {"audit_s": "30.0"},
    "smartstep.trace": {"word_layout": '"lsb-io-shift"', "verified": "true"},
}
HEAD = MIXED[: MIXED.index("[bus.axis.smartstep]")]
TAIL = MIXED[MIXED.index('[[bus.axis]]\nname = "spool"') :]


@pytest.fixture
def config(tmp_path):
    path = tmp_path / "mixed.toml"
    path.write_text(MIXED)
    return path


def smartstep_of(config, axis):
    return next(each for bus in load_config(config).bus for each in bus.axis if each.name == axis).smartstep


def test_tables_that_are_missing_come_behind_the_axis(config):
    set_for_axis(config, "feed", {"smartstep.trace.trigger_map": BITS})

    added = "\n[bus.axis.smartstep.trace.trigger_map]\n" + "".join(f"{key} = {text}\n" for key, text in BITS.items())
    assert smartstep_of(config, "feed").trace.trigger_map.rising == 0x4000
    assert smartstep_of(config, "spool").trace.trigger_map is None
    assert config.read_text().replace(added, "") == MIXED
    assert list(config.parent.iterdir()) == [config]


INLINE = """[bus.axis.smartstep]
trace = { word_layout = "msb-io", chunk_bytes = 100 }
"""
TABLES = """[bus.axis.smartstep.trace]
word_layout = "msb-io" # as on the bench
chunk_bytes = 100
"""


@pytest.mark.parametrize("own", ["[bus.axis.smartstep]\n", INLINE, TABLES], ids=["none", "inline", "tables"])
def test_values_that_are_there_are_replaced_and_others_kept(config, own):
    config.write_text(HEAD + own + "\n# the other drive\n" + TAIL)

    set_for_axis(config, "feed", LAYOUT)
    set_for_axis(config, "feed", LAYOUT)

    unit = smartstep_of(config, "feed")
    assert unit.trace.word_layout == "lsb-io-shift"
    assert unit.trace.chunk_bytes == (100 if "chunk_bytes" in own else 200)
    assert (unit.trace.verified, unit.audit_s) == (True, 30.0)
    assert ("# as on the bench" in config.read_text()) is ("# as on the bench" in own)
    assert config.read_text().endswith("\n# the other drive\n" + TAIL)


def test_a_table_in_one_line_gets_further_ones_inside(config):
    config.write_text(HEAD + "smartstep = { eeprom_budget = 9000 }\n" + TAIL)

    set_for_axis(config, "feed", LAYOUT)

    assert smartstep_of(config, "feed").trace.verified
    assert smartstep_of(config, "feed").eeprom_budget == 9000
    assert config.read_text().endswith(TAIL)


def test_values_that_no_configuration_has_leave_the_file_alone(config):
    with pytest.raises(ConfigError, match="by hand"):
        set_for_axis(config, "feed", {"smartstep.trace": {"word_layout": '"sideways"'}})

    assert config.read_text() == MIXED
    assert list(config.parent.iterdir()) == [config]


MOVED = """# the axis of the slide
[[bus.axis]] # first
model = "ls-182ap"
name = "slide"
address = 1
unit = "mm"
counts_per_unit = 1000 # 500 lines, 2 mm a turn
velocity = 10
acceleration = 100
limits = { position_min = -50, velocity = 20 } # soft
gains = { kp = 350, el = 4000 }

# the next one
[[bus.axis]]
name = "lift"
address = 2
model = "ls-182ap"
velocity = 10
acceleration = 100
[bus.axis.limits]
velocity = 30

"""
LINES = 'rig = "r"\n[[bus]]\nname = "b"\nport = "sim:b"\nbaud = 115200\n'
SIM = '[[sim]]\nname = "b"\nmodule = [{ model = "ls-182ap" }, { model = "ls-182ap" }]\n'


def test_keys_and_inline_tables_of_the_axis_itself_are_replaced_and_remarks_kept(tmp_path):
    config = tmp_path / "rig.toml"
    config.write_text(LINES + MOVED + SIM)

    set_for_axis(
        config, "slide", {"": {"direction": '"reverse"', "counts_per_unit": "900.5"}, "limits": {"velocity": "15"}}
    )
    set_for_axis(config, "lift", {"": {"velocity": "5.0"}, "limits": {"velocity": "6.5"}})

    expected = MOVED.replace("= 1000 #", "= 900.5 #").replace("velocity = 20 }", "velocity = 15 }")
    expected = expected.replace(
        "gains = { kp = 350, el = 4000 }\n", 'gains = { kp = 350, el = 4000 }\ndirection = "reverse"\n'
    )
    head, name, tail = expected.partition('name = "lift"')
    tail = tail.replace("velocity = 10", "velocity = 5.0").replace("velocity = 30", "velocity = 6.5")
    assert config.read_text() == LINES + head + name + tail + SIM


def test_an_edit_can_be_seen_before_it_is_made(config):
    edited = edited_for_axis(config, "feed", {"smartstep.trace": {"word_layout": '"lsb-io-shift"'}})

    assert "lsb-io-shift" in edited
    assert config.read_text() == MIXED
    assert list(config.parent.iterdir()) == [config]


def test_a_number_is_written_with_its_unit_where_it_would_be_read_in_another(tmp_path):
    config = tmp_path / "centrifuge.toml"
    config.write_text((ROOT / "config" / "centrifuge.toml").read_text())

    set_for_axis(config, "rotor", {"": {"velocity": "0.25"}, "limits": {"velocity": "50.0", "acceleration": "9.0"}})

    rotor = load_config(config).bus[0].axis[0]
    assert (rotor.velocity, rotor.limits.velocity, rotor.limits.acceleration) == (0.25, 50.0, 9.0)
    assert 'velocity = "0.25 rev/s" #' in config.read_text()
