"""Writes what a rig publishes into one MCAP file after the other."""

from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

from ldcnd.messaging.session import Sample, SampleKind
from ldcnd.model.frozen import Frozen
from ldcnd.recording.mcap_file import McapFile
from ldcnd.recording.topics import decode_published


class Recorder:
    """A recording under way; leaving the context completes its last file.

    Args:
        path: the first file; those that follow have a number before the suffix.
        descriptions: of the rig, attached to every file, by name.
        now_ns: the wall clock, UTC in ns since 1970.
        rotate_bytes: a file that has so many bytes is followed by the next one.

    Attributes:
        messages: how many values were recorded.

    Raises:
        ConfigError: a file exists already.
    """

    def __init__(
        self, path: Path, descriptions: Mapping[str, Frozen], now_ns: Callable[[], int], rotate_bytes: int
    ) -> None:
        self.messages = 0
        self._path = path
        self._descriptions = descriptions
        self._now_ns = now_ns
        self._rotate_bytes = rotate_bytes
        self._files = 0
        self._file = self._open()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._file.__exit__(kind, error, at)

    def take(self, sample: Sample) -> None:
        """Record one value; news that a key has none any more are left out."""
        if sample.kind is SampleKind.DELETE:
            return
        value = decode_published(sample)
        if value is None:
            return
        if self._file.size_bytes >= self._rotate_bytes:
            self._file.__exit__(None, None, None)
            self._file = self._open()
        self._file.add(sample.key, value, self._now_ns())
        self.messages += 1

    def _open(self) -> McapFile:
        self._files += 1
        path = self._path if self._files == 1 else self._path.with_stem(f"{self._path.stem}-{self._files}")
        file = McapFile(path)
        for name, model in self._descriptions.items():
            file.attach(name, model, self._now_ns())
        return file
