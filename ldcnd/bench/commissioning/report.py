"""The report of commissioning an axis: one HTML file to be filed, without scripts, with nothing from elsewhere."""

from html import escape

from ldcnd.bench.commissioning.record import CommissioningRecord, Figure, PlotSeries, StepRecord
from ldcnd.bench.commissioning.step import Step
from ldcnd.printable import printable

WIDTH, HEIGHT = 560, 200
LEFT, RIGHT, TOP, BOTTOM = 80, 20, 15, 35
STYLE = """
body { font: 15px/1.45 sans-serif; max-width: 46em; margin: 2em auto; padding: 0 1em; color: #111; background: #fff }
table { border-collapse: collapse; margin: .6em 0 } td, th { border: 1px solid #999; padding: .2em .6em }
th { text-align: left }
h2 { margin-top: 1.6em } .state { font-weight: bold } .failed { color: #a00 } .done { color: #060 }
code { font-family: monospace } section { break-inside: avoid } svg { display: block; margin: .6em 0 }
@media print { body { margin: 0; max-width: none } }
"""


def html_of(record: CommissioningRecord, steps: dict[str, Step], configuration: str, version: str, at: str) -> str:
    """Return the report.

    Args:
        record: of the axis.
        steps: of the checklist, in their order.
        configuration: the file as it is now.
        version: of ldcnd.
        at: when it is written.
    """
    title = f"Commissioning of axis {record.axis} of rig {record.rig}"
    body = "\n".join(_section(step, record.of(name)) for name, step in steps.items())
    rows = "".join(
        f"<tr><td>{_text(step.title)}</td><td>{_state(record.of(name))}</td><td>{_text(record.of(name).at)}</td>"
        f"<td>{_text(record.of(name).by)}</td></tr>"
        for name, step in steps.items()
    )
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8" />
<title>{_text(title)}</title>
<style>{STYLE}</style>
</head>
<body>
<h1>{_text(title)}</h1>
<p>Written by ldcnd {_text(version)}, {_text(at)}.</p>
<table><tr><th>step</th><th>state</th><th>when</th><th>by</th></tr>{rows}</table>
{body}
<h2>Configuration</h2>
<pre><code>{_text(configuration)}</code></pre>
</body>
</html>
"""


def _section(step: Step, kept: StepRecord) -> str:
    result = kept.result
    parts = [f"<section><h2>{_text(step.title)}</h2>", f"<p>{_text(step.about)}</p>", f"<p>{_state(kept)}"]
    parts.append(f": {_text(result.text)}</p>" if result.text else "</p>")
    if kept.reopened:
        parts.append(f"<p>{_text(kept.reopened)}</p>")
    if drive := kept.basis.get("drive"):
        parts.append(f"<p>Drive: {_text(str(drive))}</p>")
    if result.figures:
        rows = "".join(
            f"<tr><td>{_text(each.what)}</td><td>{_text(_figure(each))}</td></tr>" for each in result.figures
        )
        parts.append(f"<table>{rows}</table>")
    parts += [_plot(each) for each in result.series if each.points]
    if result.proposals:
        items = "".join(f"<li><code>{_text(f'{each.name} = {each.literal}')}</code></li>" for each in result.proposals)
        parts.append(f"<p>Proposed for the configuration:</p><ul>{items}</ul>")
    return "\n".join([*parts, "</section>"])


def _state(kept: StepRecord) -> str:
    state = kept.result.state.value
    return f'<span class="state {state}">{_text(state.replace("_", " "))}</span>'


def _figure(figure: Figure) -> str:
    value = figure.value if isinstance(figure.value, str) else f"{figure.value:.6g}"
    return f"{value} {figure.unit}".strip()


def _plot(series: PlotSeries) -> str:
    """Return points, joined in their order, with the ends of both axes."""
    xs, ys = [x for x, _ in series.points], [y for _, y in series.points]
    low_x, high_x = _range(xs)
    low_y, high_y = _range([0.0, *ys])
    across, down = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM

    def place(x: float, y: float) -> tuple[float, float]:
        return LEFT + across * (x - low_x) / (high_x - low_x), TOP + down * (high_y - y) / (high_y - low_y)

    places = [place(x, y) for x, y in series.points]
    line = " ".join(f"{x:.1f},{y:.1f}" for x, y in places)
    dots = "".join(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" />' for x, y in places)
    _, zero = place(low_x, 0.0)
    right, bottom = WIDTH - RIGHT, HEIGHT - BOTTOM
    labels = [
        (LEFT, bottom + 15, "start", f"{low_x:.4g}"),
        (right, bottom + 15, "end", f"{high_x:.4g}"),
        ((LEFT + right) / 2, HEIGHT - 5, "middle", series.x),
        (LEFT - 6, bottom, "end", f"{low_y:.3g}"),
        (LEFT - 6, TOP + 8, "end", f"{high_y:.3g}"),
    ]
    words = "".join(
        f'<text x="{x:.0f}" y="{y:.0f}" text-anchor="{anchor}">{_text(text)}</text>' for x, y, anchor, text in labels
    )
    return (
        f"<p>{_text(series.title)}, {_text(series.y)}</p>"
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" font-size="11">'
        f'<rect x="{LEFT}" y="{TOP}" width="{across}" height="{down}" fill="none" stroke="#999" />'
        f'<line x1="{LEFT}" x2="{right}" y1="{zero:.1f}" y2="{zero:.1f}" stroke="#bbb" />'
        f'<polyline points="{line}" fill="none" stroke="#06c" /><g fill="#06c">{dots}</g>{words}</svg>'
    )


def _range(values: list[float]) -> tuple[float, float]:
    low, high = min(values), max(values)
    return (low, high) if low < high else (low - 1.0, high + 1.0)


def _text(text: str) -> str:
    return escape(printable(text, keep="\n"))
