"""Files of simulated lines: what is refused, and what becomes of what is accepted."""

import re
import shlex
from pathlib import Path

import pytest

from ldcnd.contract.errors import ConfigError
from ldcnd.drives.toml import read_toml
from ldcnd.sim.chain import Delivery
from ldcnd.sim.cli import command
from ldcnd.sim.faults import FaultKind, LineFault
from ldcnd.sim.ldcn.chain import MODELS, OLD_NAMES, build_chain
from ldcnd.sim.ldcn.power import FaultCondition
from ldcnd.sim.ldcn.quirks import PositionErrorClearing
from ldcnd.sim.ldcn.simulation import SimulatedChainConfig, SimulationConfig
from ldcnd.sim.line_config import FaultPlanConfig

TESTS = Path(__file__).parents[1]
DOCS = TESTS.parent / "docs"
HOW_TO = DOCS / "how-to" / "simulate-a-line.md"
REFERENCE = DOCS / "reference" / "simulator.md"


def load(tmp_path, text):
    file = tmp_path / "line.toml"
    file.write_text(text)
    return read_toml(file, SimulationConfig)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ('[[module]]\nmodel = "ls999"', "module[0].model: no such simulated module; known are ls-182ap"),
        ('[[module]]\nmodel = "picio"\nconditions = ["stalled"]', "module[0]: conditions: a pic-io has no motor"),
        ('[[module]]\nmodel = "ls182ap"\nplant = { mass = 1 }', "module[0].plant.mass: there is no such key"),
        ('[[module]]\nmodel = "ls182ap"\n[[event]]\nat_s = 1\nmodule = 1', "event[0]: an event needs exactly one"),
        ('[[module]]\nmodel = "ls182ap"\n[[event]]\nat_s = 1\nmodule = 2\npower = "off"', "there is no module 2"),
        ('[[module]]\nmodel = "ls182ap"\n[[fault]]\nkind = "unplugged"', "fault[0]: unplugged needs longest_s"),
        ("seed = 1", "module: Field required"),
        ("seed = ", "not valid TOML"),
    ],
)
def test_a_wrong_file_is_refused_with_file_key_and_reason(tmp_path, text, complaint):
    file = tmp_path / "wrong.toml"
    file.write_text(text)

    with pytest.raises(ConfigError) as refused:
        read_toml(file, SimulationConfig)

    assert refused.value.message.startswith(f"{file}: ")
    assert complaint in refused.value.message


def test_what_is_left_out_stays_as_it_is_for_the_model(tmp_path):
    config = load(tmp_path, '[[module]]\nmodel = "ls182ap"\nbehaviour = { position_error_clearing = "by_closing" }')

    (module,) = build_chain(config.spec()).modules

    assert module.settings.position_error_clearing is PositionErrorClearing.BY_CLOSING
    assert (module.settings.version, module.settings.always_obeys_global_reset) == (20, True)
    assert module.settings.drift_ppm != 0.0


def test_events_happen_at_their_instants_counted_from_the_opening(tmp_path):
    config = load(
        tmp_path,
        """
        module = [{ model = "ls182ap", conditions = ["stop_input"] }, { model = "picio" }]
        event = [
            { at_s = 2.0, module = 1, ends = "stop_input" },
            { at_s = 1.0, module = 1, begins = "overheat" },
            { at_s = 3.0, module = 2, power = "off" },
        ]
        """,
    )
    chain = build_chain(config.spec(starts_at_s=100.0))
    drive, io = chain.modules
    seen = []

    for at_s in (100.9, 101.1, 102.1, 103.1):
        chain.advance(at_s)
        seen.append((set(drive.stage.conditions), io._powered))

    assert seen == [
        ({FaultCondition.STOP_INPUT}, True),
        ({FaultCondition.STOP_INPUT, FaultCondition.OVERHEAT}, True),
        ({FaultCondition.OVERHEAT}, True),
        ({FaultCondition.OVERHEAT}, False),
    ]
    assert chain.next_event_s() is None


def test_faults_are_counted_from_the_opening(tmp_path):
    config = load(
        tmp_path,
        """
        delivery = "bytewise"
        module = [{ model = "picio" }]
        fault = [{ kind = "reply_delayed", probability = 0.5, from_s = 1, until_s = 2, longest_s = 0.01 }]
        """,
    )

    spec = config.spec(delivery=config.delivery, starts_at_s=10.0)

    assert spec.delivery is Delivery.BYTEWISE
    assert spec.faults.faults == (LineFault(FaultKind.REPLY_DELAYED, 0.5, 11.0, 12.0, 0.01),)


def test_index_pulses_can_be_nearer_than_a_revolution(tmp_path):
    plant = "{ index_spacing_counts = 500, index_at_counts = 0, index_width_counts = 4 }"
    config = load(tmp_path, f'[[module]]\nmodel = "ls182ap"\nplant = {plant}')
    shaft = build_chain(config.spec()).modules[0].shaft

    on_index = []
    for counts in range(1200):
        shaft.position_counts = float(counts)
        if shaft.on_index:
            on_index.append(counts)

    assert on_index == [0, 1, 2, 3, 500, 501, 502, 503, 1000, 1001, 1002, 1003]


def test_a_machine_may_have_a_load_a_dead_time_backlash_and_wrong_wires(tmp_path):
    plant = (
        "{ load_nm = -0.02, delay_s = 0.001, backlash_counts = 8, motor_reversed = true, encoder_disconnected = true,"
        " phase_lost = true, pole_pairs = 3 }"
    )
    config = load(tmp_path, f'[[module]]\nmodel = "ls182ap"\nplant = {plant}')

    machine = build_chain(config.spec()).modules[0].shaft.plant

    assert (machine.load_nm, machine.delay_s, machine.backlash_counts) == (-0.02, 0.001, 8)
    assert machine.motor_reversed
    assert machine.encoder_disconnected
    assert (machine.phase_lost, machine.pole_pairs) == (True, 3)


def test_a_line_of_a_rig_takes_the_same_modules():
    line = SimulatedChainConfig.model_validate({"module": [{"model": "ls182ap"}], "fault": [{"kind": "echo"}]})

    assert line.spec().baud_check
    assert line.spec().modules[0].plant.forward_limit_counts > 1_000_000


@pytest.mark.parametrize(
    "block", re.findall(r"```toml\n(.*?)```", HOW_TO.read_text(), re.DOTALL), ids=["chain", "cabinet", "fault plan"]
)
def test_files_of_the_how_to_are_accepted(tmp_path, block):
    file = tmp_path / "block.toml"
    file.write_text(block)

    assert read_toml(file, FaultPlanConfig if "[[fault]]" in block else SimulationConfig)


@pytest.mark.parametrize("line", re.findall(r"^ldcnd sim (.*)$", HOW_TO.read_text(), re.MULTILINE))
def test_commands_of_the_how_to_are_understood(line):
    context = command.make_context("sim", shlex.split(line))

    assert (context.params["chain"] is None) is not (context.params["file"] is None)


def test_the_reference_lists_the_modules_as_they_are():
    rows = re.findall(r"^\| `([a-z0-9-]+)` \| .* \| (\d+) \| (yes|no) \|$", REFERENCE.read_text(), re.MULTILINE)

    assert {name: (int(version), reset == "yes") for name, version, reset in rows} == {
        name: (settings.version, settings.always_obeys_global_reset) for name, (_, settings) in MODELS.items()
    }


def test_a_version_of_another_model_is_refused():
    with pytest.raises(ValueError, match="version 5; that is a pic-servo-cmc"):
        SimulatedChainConfig.model_validate({"module": [{"model": "pic-servo-v4", "behaviour": {"version": 5}}]})


def test_older_spellings_of_the_models_stay_valid():
    for old, name in OLD_NAMES.items():
        (module,) = SimulatedChainConfig.model_validate({"module": [{"model": old}]}).module
        assert module.model == name
        assert name in MODELS
