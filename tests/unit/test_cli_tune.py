"""`ldcnd tune` without a rig: how it shows what was found."""

from ldcnd.bench.tuning import report as guided
from ldcnd.bench.tuning.report import Estimate, LoopMargins, MoveFigures, TuningReport

PREDICTED = MoveFigures(settling_s=0.016, settled=True, overshoot=0.022, following_error=0.111, error=0.0)
REPORT = TuningReport(
    axis="x",
    unit="mm",
    within=2.0,
    farthest=1.2,
    plant={"friction_pwm": Estimate(value=0.66, interval=0.002, unit="PWM steps")},
    left_counts=0.3,
    distance=1.0,
    old_gains={"kp": 350, "kd": 3000},
    gains={"kp": 164, "kd": 882},
    margins=LoopMargins(bandwidth_hz=24.5, phase_deg=46.0, gain_db=None),
    predicted=PREDICTED,
    before=PREDICTED.model_copy(update={"settled": False}),
)


def test_predicted_stands_beside_measured():
    lines = guided.table(REPORT)

    columns = [line.split() for line in lines[-5:]]
    assert columns[0] == ["old", "gains", "predicted", "new", "gains"]
    assert columns[1] == ["settling", "not", "settled", "16", "ms", "-"]
    assert columns[2] == ["overshoot", "2.2%", "2.2%", "-"]
    assert "bandwidth 24.5 Hz, phase margin 46 degrees, gain margin no limit" in lines
    assert lines[0] == "model: friction 0.66 +- 0.002 PWM steps"


def test_kept_gains_are_a_line_for_the_configuration_and_refused_ones_say_why():
    kept = guided.ending(REPORT.model_copy(update={"applied": True}))
    refused = guided.ending(REPORT.model_copy(update={"objection": "it settles in 90 ms, with the old gains in 20 ms"}))

    assert kept[-1] == "gains = { kp = 164, kd = 882 }"
    assert refused == ["x: not better: it settles in 90 ms, with the old gains in 20 ms; it is off, with its old gains"]
