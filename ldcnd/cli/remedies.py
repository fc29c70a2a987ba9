"""Remedies as the daemon says them name commands of its interface; here they name commands that can be typed."""

import re

_TERMS = (
    (r'send power \{"on": true\}', "ldcnd axis power {axis} on"),
    (r"send home or set_position", "ldcnd axis home {axis}, or ldcnd axis set-position {axis} POSITION"),
    (r'send set_outputs with "input"', "ldcnd axis outputs {axis} --limit1 input --limit2 input"),
    (r"send at least kp and el", "ldcnd axis gains {axis} --kp KP --el EL, and more as needed"),
    (r"send set_gains", "ldcnd axis gains {axis} --kp KP --el EL"),
    (r"send reset", "ldcnd axis reset {axis}"),
    (r"send halt", "ldcnd axis halt {axis}"),
    (r"send trace_abort", "ldcnd trace abort {axis}"),
    (r"send clear_counter", "ldcnd axis clear-counter {axis}"),
    (r"send list_parameters", "ldcnd params list {axis}"),
    (r"or acquire it with force", "or take it with ldcnd lease hold --axis {axis} --force -- COMMAND"),
    (r"acquire (?:a new one|one first|it again|that axis, too)", "ldcnd lease hold --axis {axis} -- COMMAND"),
    (r"look at the events", "ldcnd events"),
)


def in_typed_terms(remedy: str, axis: str | None) -> str:
    """Return a remedy in the words of the command line.

    Args:
        remedy: as the daemon says it.
        axis: what it is about; None when it is not about one axis.
    """
    for term, words in _TERMS:
        remedy = re.sub(term, words.replace("{axis}", axis or "AXIS"), remedy)
    return remedy
