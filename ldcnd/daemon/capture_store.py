"""Captures on disk: written when something has gone wrong, a bounded number of them, the oldest thrown away.

Nothing here runs on the event loop. The text is written in small pieces: between two of them another thread may have
the interpreter, so a bus waits for less than a millisecond.
"""

import re
from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import islice
from pathlib import Path

from ldcnd.bus.capture import Capture, capture_lines
from ldcnd.log import get_logger

log = get_logger("captures")

SUFFIX = ".capture"
PIECE_LINES = 64


class CaptureStore:
    """A directory of captures.

    Args:
        directory: made when the first capture is written.
        files: so many captures at most.
        total_bytes: so much disk space at most; the newest capture stays even if it is larger.
    """

    def __init__(self, directory: Path, files: int, total_bytes: int) -> None:
        self._directory = directory
        self._files = files
        self._total_bytes = total_bytes

    def write(self, capture: Capture) -> Path | None:
        """Write one capture and return its file; None, and a line in the log, where that is impossible."""
        header = capture.header
        until_ns = header.zero_ns + round(header.until_s * 1e9)
        when = datetime.fromtimestamp(until_ns / 1e9, UTC).strftime("%Y%m%dT%H%M%S.%fZ")
        cause = re.sub(r"[^a-z0-9]+", "-", header.cause.lower()).strip("-")[:60]
        path = self._directory / f"{when}-{header.bus}-{cause}{SUFFIX}"
        part = path.with_suffix(".part")
        try:
            self._directory.mkdir(parents=True, exist_ok=True)
            with part.open("wb", buffering=0) as file:
                for piece in _pieces(capture_lines(header, capture.records, _without_words)):
                    file.write(piece)  # lets go of the interpreter
            part.replace(path)
            self._thin_out(path)
        except OSError as error:
            log.error("capture not written", bus=header.bus, cause=header.cause, file=str(path), reason=str(error))
            return None
        size = path.stat().st_size
        log.warning("capture written", bus=header.bus, cause=header.cause, file=str(path), size_bytes=size)
        return path

    def _thin_out(self, newest: Path) -> None:
        """Delete the oldest captures, which have the smallest names, and what a crash has left unfinished."""
        for left in self._directory.glob("*.part"):
            left.unlink(missing_ok=True)
        captures = sorted(self._directory.glob(f"*{SUFFIX}"))
        sizes = {path: path.stat().st_size for path in captures}
        while len(sizes) > self._files or (sum(sizes.values()) > self._total_bytes and len(sizes) > 1):
            oldest = next(path for path in sizes if path != newest or len(sizes) == 1)
            oldest.unlink(missing_ok=True)
            del sizes[oldest]


def _without_words(_record: object) -> str:
    return ""


def _pieces(lines: Iterator[str]) -> Iterator[bytes]:
    while piece := list(islice(lines, PIECE_LINES)):
        yield ("\n".join(piece) + "\n").encode()
