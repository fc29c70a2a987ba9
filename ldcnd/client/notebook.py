"""Display in notebooks of an axis, a motion, a rig and a trace: small tables, and curves without any library."""

from collections.abc import Iterable, Sequence
from html import escape

WIDTH, HEIGHT, MARGIN = 480, 90, 4
"""Of the pane of one channel, in pixels."""


def table(caption: str, rows: Iterable[Sequence[object]], head: Sequence[str] = ()) -> str:
    """Return rows as an HTML table; every cell is text."""
    above = f"<tr>{''.join(f'<th>{escape(title)}</th>' for title in head)}</tr>" if head else ""
    body = "".join(f"<tr>{''.join(f'<td>{escape(str(cell))}</td>' for cell in row)}</tr>" for row in rows)
    return f"<table><caption>{escape(caption)}</caption>{above}{body}</table>"


def panes(caption: str, seconds: Sequence[float], channels: Iterable[tuple[str, Sequence[float | None]]]) -> str:
    """Return one SVG pane for each channel against the same seconds, with its name and its range."""
    drawn = "".join(_pane(title, seconds, values) for title, values in channels)
    return f"<figure><figcaption>{escape(caption)}</figcaption>{drawn}</figure>"


def _pane(title: str, seconds: Sequence[float], values: Sequence[float | None]) -> str:
    known = [(at, value) for at, value in zip(seconds, values, strict=True) if value is not None]
    if not known:
        return f"<div>{escape(title)}: no values</div>"
    low, high = min(value for _, value in known), max(value for _, value in known)
    first, last = seconds[0], seconds[-1]
    across = (WIDTH - 2 * MARGIN) / ((last - first) or 1.0)
    up = (HEIGHT - 2 * MARGIN) / ((high - low) or 1.0)
    points = " ".join(f"{MARGIN + (at - first) * across:.1f},{HEIGHT - MARGIN - (y - low) * up:.1f}" for at, y in known)
    return (
        f"<div>{escape(title)}: {low:g} to {high:g}</div>"
        f'<svg width="{WIDTH}" height="{HEIGHT}" role="img" aria-label="{escape(title)}">'
        f'<polyline points="{points}" fill="none" stroke="currentColor"/></svg>'
    )
