from pathlib import Path

import pytest

from ldcnd.config.rig import load_config
from ldcnd.contract.errors import ConfigError
from ldcnd.contract.samples import MonitorName

GOOD = """
rig = "bench"
[[bus]]
name = "steps"
port = "/dev/ttyUSB0"
family = "smartstep"
smartstep = { framing = "8n1-soft-parity" }
[[bus.axis]]
name = "feed"
address = 1
model = "smartstep"
unit = "rev"
counts_per_unit = 8000
[bus.axis.smartstep]
monitors = { torque_reference = 2 }
"""
SIM = """
[[sim]]
name = "z"
"""


def load(tmp_path: Path, text: str):
    path = tmp_path / "rig.toml"
    path.write_text(text)
    return load_config(path)


def test_a_smartstep_needs_no_key_for_motion_and_is_read_slowly(tmp_path):
    axis = load(tmp_path, GOOD).bus[0].axis[0]

    assert axis.smartstep.monitors == {MonitorName.TORQUE_REFERENCE: 2}
    assert (axis.rates.position, axis.rates.state, axis.rates.adc) == (1.0, 1.0, 0.0)


def test_unit_0_is_a_unit(tmp_path):
    assert load(tmp_path, GOOD.replace("address = 1", "address = 0")).bus[0].axis[0].address == 0


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("address = 1", "address = 16"), ["address", "0 to 15"]),
        (("address = 1", "address = 1\nvelocity = 3"), ["velocity", "no motion"]),
        (("address = 1", "address = 1\ngains = { kp = 1, el = 1 }"), ["gains", "no motion"]),
        (('model = "smartstep"', 'model = "ls-182ap"\nvelocity = 1\nacceleration = 1'), ["model", "family smartstep"]),
        (
            ('family = "smartstep"', 'family = "ldcn"'),
            ["model", "family ldcn", "another family"],
        ),
        (('framing = "8n1-soft-parity"', 'wiring = "2-wire"'), ["2-wire", "accept_two_wire"]),
        (('framing = "8n1-soft-parity"', 'echo = "expect"'), ["echo", "four wires"]),
        (("torque_reference", "torque"), ["monitors", "torque"]),
        (("monitors", "eeprom_budget = 10001\nmonitors"), ["eeprom_budget", "10000"]),
        (('port = "/dev/ttyUSB0"', 'port = "sim:z"'), ["sim:z"]),
    ],
)
def test_a_wrong_value_says_what_is_allowed(tmp_path, change, words):
    with pytest.raises(ConfigError) as error:
        load(tmp_path, GOOD.replace(*change))

    for word in words:
        assert word in error.value.message


@pytest.mark.parametrize(
    ("rates", "required", "least_ms", "slow"),
    [
        ("position = 10, velocity = 0, state = 1", ", standstill = true", 2667, "state and velocity"),
        ("position = 10, velocity = 0, state = 1", ", below = 2", 2667, "state and velocity"),
        ("position = 0, velocity = 10, state = 10", ", standstill = true", 267, "state and velocity and position"),
        ("position = 2, velocity = 4, state = 5", ", standstill = true", 1334, "position"),
        ("position = 10, velocity = 0, state = 1", "", 267, "it"),  # any word tells that it answers
    ],
)
def test_an_interlock_waits_for_the_slowest_word_that_its_requirement_needs(tmp_path, rates, required, least_ms, slow):
    text = GOOD.replace("[bus.axis.smartstep]", f"rates = {{ {rates} }}\n[bus.axis.smartstep]")
    rule = f'[[interlock]]\nname = "calm"\nof = "feed"\nrequires = [{{ axis = "feed"{required} }}]\nwithin_ms = '

    assert load(tmp_path, f"{text}{rule}{least_ms}").interlock[0].within_ms == least_ms
    with pytest.raises(ConfigError, match=f"less than two polls of feed take; allow .* or poll {slow} faster"):
        load(tmp_path, f"{text}{rule}{least_ms - 1}")


def test_unit_0_must_be_alone(tmp_path):
    axis = GOOD[GOOD.index("[[bus.axis]]") :]

    with pytest.raises(ConfigError, match="alone"):
        load(tmp_path, GOOD + axis.replace('"feed"', '"spool"').replace("address = 1", "address = 0"))


def test_a_simulated_line_has_modules_or_units(tmp_path):
    with pytest.raises(ConfigError, match="either modules or units"):
        load(tmp_path, GOOD + SIM)


def test_a_simulated_line_has_no_drives_of_another_family(tmp_path):
    with pytest.raises(ConfigError, match=r"unit: drives of another family have this key"):
        load(tmp_path, GOOD + SIM + 'module = [{ model = "ls-182ap" }]\nunit = [{ number = 1 }]')


def test_a_smartstep_line_is_simulated_by_units(tmp_path):
    text = GOOD.replace("/dev/ttyUSB0", "sim:z") + SIM

    assert load(tmp_path, text + "unit = [{ number = 1 }]").sim[0].unit[0].number == 1
    with pytest.raises(ConfigError, match="units"):
        load(tmp_path, text + 'module = [{ model = "ls182ap" }]')
