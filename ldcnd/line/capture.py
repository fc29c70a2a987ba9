"""A capture: what was on one line for some time, as a file for people, for tests and for playing it back.

The text begins with a header, one fact a line behind a number sign, and goes on with the records of the wire log, each
perhaps followed by a comment that says in words what it means. So whatever reads wire logs reads captures.
"""

import json
import re
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from itertools import takewhile
from typing import Literal

from pydantic import Field, JsonValue

from ldcnd.contract.errors import MalformedRequest
from ldcnd.contract.frozen import Frozen
from ldcnd.line.flight_recorder import WireRecord, parse_records

TITLE = "# ldcnd wire capture"
_FACT = re.compile(r"# (\w+): (.+)")


class CaptureHeader(Frozen):
    """The origin of a capture."""

    format: Literal[1] = 1
    """Version of the text's format."""
    version: str
    """Of ldcnd."""
    bus: str
    """The line."""
    family: str
    """The drive family on it: how the bytes are to be read."""
    port: str
    """Where the line was connected."""
    baud: int
    """The line's rate when the capture was made; changes within it are records."""
    instance: str
    """Names the run of the daemon; the ids of its commands begin with it."""
    zero_ns: int
    """The wall time at which the records' clock was 0, UTC in ns since 1970."""
    started_s: float
    """The time of the records' clock when the daemon was started, in seconds."""
    until_s: float
    """The time of the records' clock when the capture was made, in seconds."""
    first_record: int = Field(ge=0)
    """Number of the first record; 0 when nothing that happened since the daemon started is missing."""
    cause: str = "asked for"
    """Why the capture was made."""
    config: dict[str, JsonValue] | None = None
    """The rig's configuration with this line only; null where it is not known."""


@dataclass(frozen=True, slots=True)
class Capture:
    """A header and the records, oldest first."""

    header: CaptureHeader
    records: tuple[WireRecord, ...]


def capture_lines(
    header: CaptureHeader, records: Iterable[WireRecord], describe: Callable[[WireRecord], str]
) -> Iterator[str]:
    """Yield the lines of a capture's text, without line ends; `describe` puts records into words where it can."""
    yield TITLE
    for name in CaptureHeader.model_fields:
        yield f"# {name}: {json.dumps(getattr(header, name))}"
    for record in records:
        yield str(record)
        if words := describe(record):
            yield f"#   {words}"


def parse_capture(text: str) -> Capture:
    """Read back the text of a capture.

    Raises:
        MalformedRequest: it has no such header, or a line can not be read.
    """
    title, *lines = text.splitlines() or [""]
    if title != TITLE:
        raise MalformedRequest(f"not a capture: the first line is not {TITLE!r}", value=title)
    # up to the first record: what comments say of records may look like a fact
    facts = (match for line in takewhile(lambda line: line.startswith("#"), lines) if (match := _FACT.fullmatch(line)))
    try:
        header = CaptureHeader.model_validate({fact[1]: json.loads(fact[2]) for fact in facts})
    except ValueError as error:
        raise MalformedRequest(f"the header of a capture can not be read: {error}") from error
    return Capture(header, parse_records(lines))
