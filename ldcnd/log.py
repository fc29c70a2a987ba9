"""Structured logging: fixed phrases with fields, for a terminal, for another program, or for the journal.

In the journal every field can be queried, such as EXTRA_BUS, EXTRA_AXIS, EXTRA_COMMAND_ID and EXTRA_CODE, where the
package logging-journald is installed; without it, records keep their priority and carry the fields in their text.
Source: sd-daemon(3) for the prefixes of lines, systemd.exec(5) "$JOURNAL_STREAM".
"""

import importlib
import logging
import math
import os
import sys
import time
from collections.abc import Callable, Mapping, MutableMapping
from typing import TYPE_CHECKING, Any, TextIO, cast

if TYPE_CHECKING:
    import structlog

from ldcnd.printable import printable

PRIORITIES = {logging.DEBUG: 7, logging.INFO: 6, logging.WARNING: 4, logging.ERROR: 3, logging.CRITICAL: 2}
"""Levels as syslog and the journal number them."""


def get_logger(name: str) -> "structlog.typing.FilteringBoundLogger":
    """Return the logger of one part of the daemon; `name` is its noun."""
    _load_structlog()
    import structlog  # noqa: PLC0415 - a client never comes here

    logger: structlog.typing.FilteringBoundLogger = structlog.get_logger(f"ldcnd.{name}")
    return logger


def _load_structlog() -> None:
    """Load structlog without rich, which it takes if it is there: 5 MB and 0.1 s, for tracebacks that here are text."""
    if "structlog" in sys.modules or "rich" in sys.modules:
        return
    sys.modules["rich"] = None  # type: ignore[assignment] # so Python spells "there is no such module"
    try:
        importlib.import_module("structlog")
    finally:
        del sys.modules["rich"]


def get_lazy_logger(name: str) -> "structlog.typing.FilteringBoundLogger":
    """Return a logger of what clients load, too: structlog takes longer to load than many a call runs."""
    return cast("structlog.typing.FilteringBoundLogger", _LazyLogger(name))


class _LazyLogger:
    """Loads structlog with its first record."""

    def __init__(self, name: str) -> None:
        self._name = name

    def __getattr__(self, method: str) -> object:
        if method == "_logger":
            self._logger = get_logger(self._name)
            return self._logger
        return getattr(self._logger, method)


class LogLimit:
    """Limits a record that any client can cause, so that it cannot fill a disk.

    Args:
        count: maximum number of records in a period.
        period_s: how long it is, s.
        now_s: returns the time, s.
    """

    def __init__(self, count: int = 20, period_s: float = 10.0, now_s: Callable[[], float] = time.monotonic) -> None:
        self._count = count
        self._period_s = period_s
        self._now_s = now_s
        self._since_s = -math.inf
        self._passed = 0
        self._held_back = 0

    def admit(self) -> dict[str, int] | None:
        """Return fields for a record that may pass, with how many have not since the last one; None for the others."""
        now_s = self._now_s()
        if now_s - self._since_s >= self._period_s:
            self._since_s, self._passed = now_s, 0
        if self._passed >= self._count:
            self._held_back += 1
            return None
        self._passed += 1
        held_back, self._held_back = self._held_back, 0
        return {"held_back": held_back} if held_back else {}


def configure_logging(*, json: bool = False, level: str = "info") -> None:
    """Send log records to standard error, as text for people or as JSON lines; to the journal where that listens there.

    Args:
        json: one JSON object a line instead of text, also in the journal.
        level: debug, info, warning or error.
    """
    _load_structlog()
    import structlog  # noqa: PLC0415 - only programs that log load it

    journal = not json and is_journal(sys.stderr, os.environ)
    processors: list[structlog.typing.Processor] = [structlog.processors.format_exc_info, _fit_for_terminals]
    if journal:
        handler = _journal_handler(sys.stderr)
        processors.append(_text_and_fields)
    else:
        handler = logging.StreamHandler(sys.stderr)
        processors += [
            structlog.stdlib.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.JSONRenderer() if json else structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty()),
        ]
    structlog.configure(
        processors=processors,
        # what is not wanted costs a call and no more; loggers are put together once
        wrapper_class=structlog.make_filtering_bound_logger(level),
        logger_factory=structlog.stdlib.LoggerFactory(),
        cache_logger_on_first_use=True,
    )
    logging.basicConfig(handlers=[handler], level=level.upper(), format="%(message)s", force=True)


def is_journal(stream: TextIO, environment: Mapping[str, str]) -> bool:
    """Tell whether what is written to the stream goes to the journal."""
    try:
        status = os.fstat(stream.fileno())
    except (OSError, ValueError):
        return False
    return environment.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


class PrefixedLines(logging.Formatter):
    """Puts the priority in front of every line, as the journal takes it from a service's standard error."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the record's lines; each becomes an entry of its own."""
        prefix = f"<{PRIORITIES.get(record.levelno, PRIORITIES[logging.INFO])}>"
        return "\n".join(prefix + line for line in super().format(record).splitlines())


def _journal_handler(stream: TextIO) -> logging.Handler:
    handler: logging.Handler
    try:
        journald = importlib.import_module("logging_journald")  # optional: ldcnd[journal]
    except ImportError:
        handler = logging.StreamHandler(stream)
        handler.setFormatter(PrefixedLines())
    else:
        handler = journald.JournaldLogHandler(identifier="ldcnd", use_message_id=False)
    return handler


def _fit_for_terminals(_logger: object, _method: str, event: MutableMapping[str, Any]) -> MutableMapping[str, Any]:
    """Show control characters as escapes: fields repeat untrusted text."""
    for key, value in event.items():
        if isinstance(value, str):
            event[key] = printable(value, keep="\n\t" if key == "exception" else "")
    return event


def _text_and_fields(
    _logger: object, _method: str, event: MutableMapping[str, Any]
) -> tuple[tuple[str], Mapping[str, Mapping[str, Any]]]:
    """Return what the standard logger takes: the phrase with its fields as text, and the fields by themselves."""
    phrase, trace = str(event.pop("event", "")), event.pop("exception", "")
    text = " ".join([phrase, *(f"{key}={value!s}" for key, value in event.items() if value is not None)])
    taken = logging.makeLogRecord({}).__dict__.keys() | {"message", "asctime"}
    fields = {f"{key}_" if key in taken else key: value for key, value in event.items() if value is not None}
    return (f"{text}\n{trace}" if trace else text,), {"extra": fields}
