"""Health reports as metrics, and the files that name them."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import promql_parser
import pytest
import yaml
from prometheus_client import CollectorRegistry, generate_latest

from ldcnd.contract.health import AxisHealth, BusHealth, CertificateHealth, DaemonHealth, LaneHealth, StopWaitHealth
from ldcnd.contract.samples import (
    AxisState,
    LinkState,
    Moving,
    PositionSample,
    Quality,
    ShadowFigure,
    ShadowSample,
    StateSample,
)
from ldcnd.contract.troubles import SOON_DAYS
from ldcnd.lab.metrics import SHADOW_FRESH_S, HealthCollector

GRAFANA = Path(__file__).parents[2] / "deploy" / "grafana"
DAEMON = DaemonHealth(
    t=1,
    seq=0,
    loop_lag_s=0.002,
    published=700,
    missed_reports=8,
    waiting_queries=3,
    dropped=9,
    version="0.0.9",
    certificate=CertificateHealth(name="bench", ends=1_800_000_000 * 10**9),
)
BUS = BusHealth(
    t=1, seq=0, bus="line0", up=True, utilisation=0.25, exchanges=1000, timeouts=3, corrupt_replies=2,
    rejected_packets=0, resent=4, resynchronisations=5, stray_bytes=6, losses=1,
    stop_wait=StopWaitHealth(bound_s=0.004, probes=10, p99_s=0.002, longest_s=0.003),
    lanes=(
        LaneHealth(
            lane="poll", waiting=7, exchanges=900, p50_s=0.002, p99_s=0.008, longest_s=0.02,
            total_s=1.8, counts=(0,) * 5 + (500, 390, 10) + (0,) * 12,
        ),
    ),
    axes=(
        AxisHealth(axis="x", link=LinkState.UP, sample_age_s=0.04, rate_wanted_hz=20.0, rate_hz=19.5, faults=2,
                   eeprom_writes=12),
        AxisHealth(axis="y", link=LinkState.DOWN, sample_age_s=None, rate_wanted_hz=20.0, rate_hz=0.0, faults=0),
    ),
)  # fmt: skip


class Clock:
    now_s = 100.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock() -> Clock:
    return Clock()


SHADOW = ShadowSample(
    t=0,
    t_error_ns=0,
    seq=0,
    quality=Quality.GOOD,
    learning=False,
    judged=120,
    figures=(
        ShadowFigure(
            figure="friction", value=3.2, usual=2.0, low=None, high=2.5, unit="PWM steps", motions=20, alarm=True
        ),
    ),
)


LATCHED = StateSample(
    t=0, t_error_ns=0, seq=0, quality=Quality.GOOD, state=AxisState.STANDSTILL, enabled=True, referenced=False,
    moving=Moving.NO, link=LinkState.UP, stop_latched=True, command=None,
)  # fmt: skip


def position(seq: int, counts: int, quality: Quality = Quality.GOOD) -> PositionSample:
    return PositionSample(
        t=seq, t_error_ns=0, seq=seq, quality=quality, value=counts, unit="count", counts=counts, following_error=None
    )


@pytest.fixture
def registry(clock) -> CollectorRegistry:
    collector = HealthCollector("sim", clock)
    collector.take(DAEMON)
    collector.take(BUS)
    collector.take_shadow("x", SHADOW)
    collector.take_state("x", LATCHED)
    for seq, counts in enumerate((0, 40, 10)):
        collector.take_position("x", position(seq, counts))
    collector.take_position("x", position(5, 1000))  # over a gap
    collector.take_position("x", position(6, 0, Quality.BAD))  # and a value that is none
    registry = CollectorRegistry()
    registry.register(collector)
    return registry


@pytest.mark.parametrize(
    ("name", "labels", "value"),
    [
        ("ldcnd_daemon_up", {}, 1.0),
        ("ldcnd_loop_lag_seconds", {}, 0.002),
        ("ldcnd_published_total", {}, 700.0),
        ("ldcnd_bus_up", {"bus": "line0"}, 1.0),
        ("ldcnd_bus_utilisation_ratio", {"bus": "line0"}, 0.25),
        ("ldcnd_bus_resent_total", {"bus": "line0"}, 4.0),
        ("ldcnd_bus_errors_total", {"bus": "line0", "kind": "timeouts"}, 3.0),
        ("ldcnd_bus_errors_total", {"bus": "line0", "kind": "stray_bytes"}, 6.0),
        ("ldcnd_missed_reports_total", {}, 8.0),
        ("ldcnd_waiting_queries", {}, 3.0),
        ("ldcnd_certificate_expiry_timestamp_seconds", {"certificate": "bench"}, 1.8e9),
        ("ldcnd_dropped_total", {}, 9.0),
        ("ldcnd_lane_waiting", {"bus": "line0", "lane": "poll"}, 7.0),
        ("ldcnd_lane_latency_seconds_bucket", {"bus": "line0", "lane": "poll", "le": "6.4e-05"}, 0.0),
        ("ldcnd_lane_latency_seconds_bucket", {"bus": "line0", "lane": "poll", "le": "0.002048"}, 500.0),
        ("ldcnd_lane_latency_seconds_bucket", {"bus": "line0", "lane": "poll", "le": "0.004096"}, 890.0),
        ("ldcnd_lane_latency_seconds_bucket", {"bus": "line0", "lane": "poll", "le": "+Inf"}, 900.0),
        ("ldcnd_lane_latency_seconds_count", {"bus": "line0", "lane": "poll"}, 900.0),
        ("ldcnd_lane_latency_seconds_sum", {"bus": "line0", "lane": "poll"}, 1.8),
        ("ldcnd_lane_longest_seconds", {"bus": "line0", "lane": "poll"}, 0.02),
        ("ldcnd_axis_eeprom_writes_total", {"bus": "line0", "axis": "x"}, 12.0),
        ("ldcnd_axis_eeprom_writes_total", {"bus": "line0", "axis": "y"}, None),
        ("ldcnd_axis_up", {"bus": "line0", "axis": "x"}, 1.0),
        ("ldcnd_axis_up", {"bus": "line0", "axis": "y"}, 0.0),
        ("ldcnd_axis_sample_age_seconds", {"bus": "line0", "axis": "x"}, 0.04),
        ("ldcnd_axis_sample_age_seconds", {"bus": "line0", "axis": "y"}, None),
        ("ldcnd_axis_rate_hertz", {"bus": "line0", "axis": "x"}, 19.5),
        ("ldcnd_axis_faults", {"bus": "line0", "axis": "x"}, 2.0),
        ("ldcnd_axis_state", {"axis": "x", "state": "standstill"}, 1.0),
        ("ldcnd_axis_state", {"axis": "x", "state": "disabled"}, 0.0),
        ("ldcnd_axis_referenced", {"axis": "x"}, 0.0),
        ("ldcnd_axis_stop_latched", {"axis": "x"}, 1.0),
        ("ldcnd_axis_stop_pending", {"axis": "x"}, 0.0),
        ("ldcnd_axis_travelled_counts_total", {"axis": "x"}, 70.0),
        ("ldcnd_shadow_value", {"axis": "x", "figure": "friction"}, 3.2),
        ("ldcnd_shadow_usual", {"axis": "x", "figure": "friction"}, 2.0),
        ("ldcnd_daemon_info", {"version": "0.0.9"}, 1.0),
        ("ldcnd_shadow_high", {"axis": "x", "figure": "friction"}, 2.5),
        ("ldcnd_shadow_low", {"axis": "x", "figure": "friction"}, None),
        ("ldcnd_shadow_alarm", {"axis": "x", "figure": "friction"}, 1.0),
    ],
)
def test_a_report_is_read_back_from_the_metrics(registry, name, labels, value):
    assert registry.get_sample_value(name, {"rig": "sim", **labels}) == value


def test_reports_that_stop_coming_are_not_shown_as_if_they_were_true(registry, clock):
    clock.now_s += SHADOW_FRESH_S + 1.0

    samples = [line for line in generate_latest(registry).decode().splitlines() if not line.startswith("#")]

    assert [line for line in samples if not line.startswith(("ldcnd_build_info", "ldcnd_axis_travelled"))] == [
        'ldcnd_daemon_up{rig="sim"} 0.0',
        'ldcnd_axis_place_known{axis="x",rig="sim"} 0.0',
        'ldcnd_axis_severity{axis="x",rig="sim"} 3.0',
        'ldcnd_axis_condition{axis="x",condition="daemon silent",rig="sim"} 1.0',
    ]


@pytest.mark.parametrize(("age_s", "known"), [(0.04, 1.0), (1.6, 1.0), (1.8, 0.0)])
def test_a_position_that_its_daemon_reports_as_old_is_not_known(clock, age_s, known):
    collector = HealthCollector("sim", clock)
    report = BUS.axes[0].model_copy(update={"sample_age_s": age_s})  # at 20 Hz it is old after 1.7 s
    collector.take(BUS.model_copy(update={"axes": (report,)}))
    collector.take_state("x", LATCHED.model_copy(update={"referenced": True}))
    registry = CollectorRegistry()
    registry.register(collector)

    assert registry.get_sample_value("ldcnd_axis_place_known", {"rig": "sim", "axis": "x"}) == known


@pytest.mark.parametrize("name", ["alerts.yml", "dashboard.json"])
def test_every_metric_that_a_file_names_exists(registry, name):
    text = (GRAFANA / name).read_text()
    exists = {sample.name for metric in registry.collect() for sample in metric.samples}

    named = set(re.findall(r"\bldcnd_\w+", text))

    assert len(named) > 5
    assert named <= exists


def expressions(name):
    text = (GRAFANA / name).read_text()
    if name.endswith(".yml"):
        return re.findall(r"^ +expr: (.+)$", text, re.MULTILINE)
    return [target["expr"] for panel in json.loads(text)["panels"] for target in panel["targets"]]


def selected(expression):
    """Return metric and label names of each selector of an expression."""
    found = []

    def visit(node):
        selector = node.vector_selector if isinstance(node, promql_parser.MatrixSelector) else node
        if isinstance(selector, promql_parser.VectorSelector):
            found.append((selector.name, {matcher.name for matcher in selector.matchers.matchers}))

    promql_parser.walk(promql_parser.parse(expression), visit)
    return found


@pytest.mark.parametrize("name", ["alerts.yml", "dashboard.json"])
def test_every_expression_is_promql_and_selects_by_labels_that_exist(registry, name):
    labels = {sample.name: set(sample.labels) for metric in registry.collect() for sample in metric.samples}

    found = [selector for expression in expressions(name) for selector in selected(expression)]

    assert len(found) >= len(expressions(name)) > 8
    for metric, used in found:
        assert used <= labels[metric], metric


@pytest.mark.system
@pytest.mark.skipif(not shutil.which("promtool"), reason="no promtool: apt-get install prometheus")
def test_alerts_fire_when_they_should(tmp_path):
    def series(name: str, values: str, **labels: str) -> dict[str, str]:
        given = ",".join(f'{label}="{value}"' for label, value in {"rig": "sim", "axis": "x", **labels}.items())
        return {"series": f"{name}{{{given}}}", "values": values}

    def fires(alert: str, at: str, *, expected: bool, **more: str) -> dict[str, object]:
        labels = {"rig": "sim", "axis": "x", **more}
        found = [{"exp_labels": labels | {"severity": "critical" if "Reference" in alert else "warning"}}]
        return {"eval_time": at, "alertname": alert, "exp_alerts": found if expected else []}

    rules = tmp_path / "alerts.yml"
    rules.write_text(re.sub(r"(?m)^ +annotations: .*\n", "", (GRAFANA / "alerts.yml").read_text()))
    tests = [
        {
            "interval": "10s",
            "input_series": [
                series("ldcnd_axis_referenced", "1x30 0x30"),
                series("ldcnd_axis_stop_latched", "0x10 1x100"),
                series("ldcnd_axis_travelled_counts_total", "0x30 0+500x30"),
                series("ldcnd_axis_state", "1x60", state="disabled"),
                series("ldcnd_axis_state", "0x60", state="error_stop"),
                series("ldcnd_build_info", "1x600", version="0.2.0"),
                series("ldcnd_daemon_info", "1x30 stale", version="0.2.0"),
                series("ldcnd_daemon_info", "_x30 1x600", version="0.1.0"),
            ],
            "alert_rule_test": [
                fires("LdcndReferenceLost", "4m", expected=False),
                fires("LdcndReferenceLost", "7m", expected=True),
                fires("LdcndStopLatched", "5m", expected=False),
                fires("LdcndStopLatched", "15m", expected=True),
                fires("LdcndMovesWithoutPower", "4m", expected=False),
                fires("LdcndMovesWithoutPower", "8m", expected=True),
                fires("LdcndVersionsDiffer", "4m", expected=False),
                fires("LdcndVersionsDiffer", "70m", expected=True, version="0.1.0"),
            ],
        }
    ]
    (tmp_path / "tests.yml").write_text(yaml.safe_dump({"rule_files": ["alerts.yml"], "tests": tests}))

    for command in (["check", "rules", str(GRAFANA / "alerts.yml")], ["test", "rules", str(tmp_path / "tests.yml")]):
        done = subprocess.run(["promtool", *command], capture_output=True, text=True, timeout=30, check=False)  # noqa: S603, S607
        assert done.returncode == 0, done.stdout + done.stderr


def test_every_alert_has_a_severity_and_a_summary():
    text = (GRAFANA / "alerts.yml").read_text()

    alerts = text.split("- alert: ")[1:]
    assert len(alerts) == len(expressions("alerts.yml"))
    for alert in alerts:
        assert re.search(r"labels: \{severity: (warning|critical)\}", alert)
        assert re.search(r"annotations: \{summary: \".+\"\}", alert)


def test_the_dashboard_is_a_document_whose_panels_do_not_overlap():
    panels = json.loads((GRAFANA / "dashboard.json").read_text())["panels"]

    cells = [(panel["gridPos"]["x"], panel["gridPos"]["y"]) for panel in panels]
    assert len(set(cells)) == len(panels) > 8
    assert all(target["expr"] for panel in panels for target in panel["targets"])


def test_the_alert_of_a_certificate_comes_as_early_as_the_other_faces_tell_of_it():
    (rule,) = [
        each
        for group in yaml.safe_load((GRAFANA / "alerts.yml").read_text())["groups"]
        for each in group["rules"]
        if each["alert"] == "LdcndCertificateEnds"
    ]
    days, seconds = map(int, rule["expr"].partition("<")[2].split("*"))

    assert days * seconds == SOON_DAYS * 86_400
