"""Numbers as they are typed: click's own types take nan and infinity for numbers."""

import math

import click


class Finite(click.FloatRange):
    """A number, within limits if there are any."""

    name = "number"

    def convert(self, value: float | str, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Return it; wrong usage if it is none."""
        number = float(super().convert(value, param, ctx))  # type: ignore[arg-type]  # click hands over text
        if not math.isfinite(number):
            self.fail(f"{value!r} is not a finite number.", param, ctx)
        return number
