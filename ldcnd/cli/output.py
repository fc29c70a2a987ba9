"""What commands print, and how they end: nothing from the network steers a terminal, no error shows a traceback."""

import os
import re
import sys

import click

from ldcnd.errors import ConfigError, LdcndError, SessionError
from ldcnd.printable import printable

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
    (r"send restart_eeprom_count", "ldcnd params restart-count {axis}"),
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


DONE = 0
FAILED = 1
"""The daemon refused, or something failed; the message says what."""
UNREACHABLE = 3
"""No daemon answered."""
WRONG_CONFIG = 78
"""The configuration cannot work (EX_CONFIG)."""
INTERRUPTED = 130
"""By Ctrl-C."""


def show_lines(*lines: str, err: bool = False) -> None:
    """Print lines of text."""
    print("\n".join(map(printable, lines)), file=sys.stderr if err else sys.stdout, flush=True)


def exit_code(error: BaseException) -> int:
    """Say how a command has ended; return its exit code. An unexpected error is raised again."""
    match error:
        case BaseExceptionGroup():
            return exit_code(_single(error))
        case click.ClickException():
            error.show()
            return error.exit_code
        case click.Abort() | KeyboardInterrupt():
            return INTERRUPTED
        case BrokenPipeError():
            # what is still buffered has no reader either: without this the interpreter complains at its end
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return FAILED
        case ConfigError():
            show_lines(*error.message.splitlines(), *_remedy(error), err=True)
            return WRONG_CONFIG
        case LdcndError():
            page = [f"  more: ldcnd fault {error.page.rpartition('/')[2]}"] if error.page else []
            show_lines(f"{error.message} [{error.code}]", *_remedy(error), *page, err=True)
            return UNREACHABLE if isinstance(error, SessionError) else FAILED
    raise error


def _remedy(error: LdcndError) -> list[str]:
    return [f"  {in_typed_terms(error.remedy, error.axis)}"] if error.remedy else []


def _single(group: BaseExceptionGroup[BaseException]) -> BaseException:
    """Return what a group of tasks failed for, if it is one thing; the group otherwise."""
    leaves = list[BaseException]()
    for error in group.exceptions:
        leaves += [_single(error)] if isinstance(error, BaseExceptionGroup) else [error]
    kinds = {type(leaf) for leaf in leaves}
    if len(kinds) > 1 or isinstance(leaves[0], BaseExceptionGroup):
        raise group
    return leaves[0]
