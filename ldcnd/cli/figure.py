"""Pictures of quantities against time; the only place that uses matplotlib, which is an extra."""

import importlib
from pathlib import Path
from typing import TYPE_CHECKING

from ldcnd.contract.errors import ConfigError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

WIDTH_IN = 10.0
ROW_IN = 2.2
DOTS_PER_INCH = 120


def stacked_rows(count: int) -> "tuple[Figure, list[Axes]]":
    """Return an empty picture and its rows, the uppermost first; they share the time below the last.

    Raises:
        ConfigError: matplotlib is missing.
    """
    try:
        module = importlib.import_module("matplotlib.figure")
    except ImportError as error:
        raise ConfigError("plotting needs matplotlib; install it with: pip install 'ldcnd[plot]'") from error
    figure: Figure = module.Figure(figsize=(WIDTH_IN, 1.0 + ROW_IN * count), dpi=DOTS_PER_INCH, layout="constrained")
    rows = figure.subplots(count, 1, sharex=True, squeeze=False)
    for (axes,) in rows:
        axes.grid(visible=True, alpha=0.3)
    return figure, [axes for (axes,) in rows]


def save_figure(figure: "Figure", path: Path) -> None:
    """Write a picture in the format that its name tells.

    Raises:
        ConfigError: it cannot be written, or its name tells no known format.
    """
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be drawn: {error}") from error
