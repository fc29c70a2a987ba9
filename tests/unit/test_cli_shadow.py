"""`ldcnd shadow` without a rig: what it needs, and how it says an alarm."""

import json
from dataclasses import asdict

import pytest

from ldcnd import parts
from ldcnd.bench.cli import commission
from ldcnd.bench.cli.commission import shadow
from ldcnd.bench.tuning import watching
from ldcnd.bench.tuning.plant import Plant
from ldcnd.bench.tuning.report import Estimate
from ldcnd.bench.tuning.shadow import FigureName
from ldcnd.bench.tuning.watching import ShadowAlarm
from ldcnd.cli.connection import Target
from ldcnd.contract.errors import ConfigError
from tests.unit.test_cli_tune import REPORT

PLANT = {name: Estimate(value=value, interval=0, unit="") for name, value in asdict(Plant(20_000, 5, 4)).items()}
ALARM = ShadowAlarm(
    axis="x",
    figure=FigureName.FRICTION,
    over=False,
    t=1_700_000_000_000_000_000,
    value=5.1,
    latest=6.02,
    usual=4,
    low=3.2,
    high=4.8,
    unit="PWM steps",
    motions=20,
    sigma=0.1,
    meaning="bearings",
)


@pytest.fixture
def report(tmp_path):
    path = tmp_path / "x.json"
    path.write_text(REPORT.model_copy(update={"plant": PLANT}).model_dump_json())
    return str(path)


def run(*arguments):
    shadow.main([*arguments], standalone_mode=False)


def test_without_numpy_one_line_names_the_extra(monkeypatch, report):
    monkeypatch.setattr(parts, "find_spec", lambda _: None)

    with pytest.raises(ConfigError, match="numpy is not installed") as error:
        run(report)
    assert error.value.remedy == "pip install 'ldcnd[bench]'"


def test_reports_must_be_of_tunings_and_of_different_axes(tmp_path, report):
    other = tmp_path / "other.json"
    with pytest.raises(ConfigError, match="cannot be read: No such file"):
        run(str(other))
    for text in ("{}", REPORT.model_dump_json()):  # the second one has less than a plant
        other.write_text(text)
        with pytest.raises(ConfigError, match="not a report of `ldcnd tune --json`"):
            run(str(other))
    with pytest.raises(ConfigError, match="two reports are of axis x"):
        run(report, report)


async def test_alarms_are_lines_or_json(monkeypatch, report, capsys):
    shown = []

    async def watch(_client, reports, show, tell, _end):
        shown.extend(each.axis for each in reports)
        tell("x: learns")
        show(ALARM)
        show(ALARM.model_copy(update={"over": True, "value": 4.1}))

    def run_work(_, work):
        with pytest.raises(StopIteration):
            work(None).send(None)

    monkeypatch.setattr(watching, "watch", watch)
    monkeypatch.setattr(commission, "on_end", lambda _: None)
    monkeypatch.setattr(Target, "run", run_work)

    run(report)
    plain = capsys.readouterr()
    run(report, "--json")
    documents = capsys.readouterr()

    assert shown == ["x", "x"]
    assert plain.err == "x: learns\n"
    begun, over = plain.out.splitlines()
    assert begun == (
        "2023-11-14T22:13:20+00:00 x: friction is 5.1 PWM steps over 20 motions, 6.02 in the last five; usual is 4,"
        " allowed 3.2 to 4.8: bearings"
    )
    assert over == "2023-11-14T22:13:20+00:00 x: friction is as usual again: 4.1 PWM steps"
    assert json.loads(documents.out.splitlines()[0])["latest"] == 6.02


@pytest.mark.parametrize("figure", FigureName)
def test_every_alarm_says_what_may_be_behind_it(figure):
    for latest in (1.0, 3.0):
        assert watching.meaning(figure, more=latest > 2.0)
