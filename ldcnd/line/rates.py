"""Rates of serial ports: which there are, and whether what a port makes of one can be read at it."""

from collections.abc import Sequence

STANDARD_BAUDS = (9600, 19_200, 38_400, 57_600, 115_200, 230_400)
RATE_TOLERANCE = 0.02
"""The kernel calls a rate by the name of its neighbour within this share (drivers/tty/tty_baudrate.c); two clocks that
differ by no more still read each other's bytes."""


def makes(asked: int, made: int | None) -> bool:
    """Return whether a port that says it sends at `made` can be received at `asked`."""
    return made is None or abs(made - asked) <= RATE_TOLERANCE * asked


def nearest(asked: int, available: Sequence[int]) -> str:
    """Return the two rates next to the requested one, in words."""
    below = [baud for baud in available if baud < asked]
    above = [baud for baud in available if baud > asked]
    return " and ".join(str(baud) for baud in (*below[-1:], *above[:1])) or "none"
