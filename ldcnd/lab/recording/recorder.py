"""Writes what a rig publishes into one MCAP file after the other.

A file has one description of the rig. The values of a daemon that was restarted wait until it has described itself;
with another configuration they go into the next file, because the same counts can be other millimetres then.
"""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Self

from ldcnd.client.network import Publication, SampleKind
from ldcnd.contract.errors import LdcndError
from ldcnd.lab.recording.mcap_file import Losses, McapFile
from ldcnd.lab.recording.messages import entry_of

FLUSH_PERIOD_S = 1.0
"""Period of writes to the disk, seconds: a recorder that is killed loses no more."""
LINGER_S = 0.1
"""Duration of a batch of samples, seconds: waking up for each costs as much as recording it."""
KEPT_SAMPLES = 16_384
"""Maximum number of samples that wait for a slow disk, about 8 s of a line of 31 axes."""


CONFIGURATION = "configuration"
"""Name of the description from which units, scales and limits follow."""


class Recorder:
    """A recording under way; leaving the context completes its last file.

    Args:
        path: the first file; those that follow have a number before the suffix.
        descriptions: of the rig, in JSON, attached to every file, by name.
        describe: returns them as they are now.
        now_ns: the wall clock, UTC in ns since 1970.
        rotate_bytes: size of a file at which the next one follows, after at most `FLUSH_PERIOD_S`.
        on_other_configuration: called with the next file when one begins because the daemon is configured anew.

    Attributes:
        messages: how many values were recorded.
        not_understood: how many were not, because they are not what their keys should carry.
        too_slow: how many were lost because this process did not take them in time.
        losses: what is missing, for whatever reason; those above included.

    Raises:
        ConfigError: a file exists already.
        OSError: a file cannot be written.
    """

    def __init__(
        self,
        path: Path,
        descriptions: Mapping[str, bytes],
        now_ns: Callable[[], int],
        rotate_bytes: int,
        describe: Callable[[], Awaitable[Mapping[str, bytes]]] | None = None,
        on_other_configuration: Callable[[Path], object] = lambda _: None,
    ) -> None:
        self.messages = 0
        self.not_understood = 0
        self.too_slow = 0
        self.losses = Losses()
        self._path = path
        self._descriptions = descriptions
        self._now_ns = now_ns
        self._rotate_bytes = rotate_bytes
        self._describe = describe
        self._on_other_configuration = on_other_configuration
        self._source = ""  # the session of the daemon that the descriptions are of
        self._undescribed: deque[Publication] = deque(maxlen=KEPT_SAMPLES)
        self._stirred = asyncio.Event()
        self._over = False
        self._problem: OSError | None = None
        self._files = 0
        self._file = self._open()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._file.complete(self._facts())

    @property
    def path(self) -> Path:
        """The file that is written now."""
        return numbered(self._path, self._files)

    @property
    def summary(self) -> str:
        """The samples recorded and lost, in one sentence for a person."""
        missing = self.losses.missing.total()
        parts = [f"{self.messages} messages", f"{missing} missing" if missing else "none missing in between"]
        if self.too_slow:
            parts.append(f"{self.too_slow} lost because this process was too slow")
        if self.not_understood:
            parts.append(f"{self.not_understood} not understood")
        if self.losses.restarts:
            parts.append(f"{self.losses.restarts} topics began again after a restart of the daemon")
        if self._files > 1:
            parts.append(f"{self._files} files, the last of which is {self.path}")
        return "; ".join(parts)

    def end(self) -> None:
        """Make `run` return."""
        self._over = True
        self._stirred.set()

    async def run(self, gave_way: Callable[[], int]) -> None:
        """Put on the disk what has come, each `FLUSH_PERIOD_S`, until `end`.

        Args:
            gave_way: returns how many samples were lost on their way to `take`.

        Raises:
            ConfigError: the next file exists already.
            OSError: a file cannot be written.
        """
        while not self._over:
            self._stirred.clear()
            try:
                async with asyncio.timeout(FLUSH_PERIOD_S):
                    await self._stirred.wait()
            except TimeoutError:
                self._file.flush()
                self._rotate()
            await self._follow_daemon()
            self.too_slow = gave_way()
        if self._problem:
            raise self._problem

    def take(self, sample: Publication) -> None:
        """Record one value; deletions of keys are left out. An error ends `run`."""
        if sample.kind is SampleKind.DELETE or self._problem:
            return
        if self._describe and sample.source != self._source:
            self._undescribed.append(sample)
            self._stirred.set()
            return
        try:
            entry = entry_of(sample)
        except LdcndError:
            self.not_understood += 1
            return
        if entry is None:
            return
        try:
            self._file.add(sample.key, entry, self._now_ns())
        except OSError as error:
            self._problem = error
            self.end()
            return
        self.messages += 1
        self.losses.saw(f"/{sample.key}", entry.seq)

    async def _follow_daemon(self) -> None:
        """Describe a daemon, and record what it has published; in the next file if it is configured anew."""
        while self._describe and self._undescribed:
            try:
                descriptions = await self._describe()
            except LdcndError:
                return  # asked again with the next sample, and each `FLUSH_PERIOD_S`
            source, changed = self._undescribed[-1].source, _is_another(descriptions, self._descriptions)
            waiting = tuple(each for each in self._undescribed if each.source == source)
            self._undescribed.clear()
            self._source, self._descriptions = source, descriptions
            if changed:
                self._begin_next()
                self._on_other_configuration(self.path)
            for sample in waiting:
                self.take(sample)

    def _rotate(self) -> None:
        """Begin the next file if this one is full."""
        if self._file.size_bytes >= self._rotate_bytes:
            self._begin_next()

    def _begin_next(self) -> None:
        full, self._file = self._file, self._open()
        full.complete(self._facts())

    def _open(self) -> McapFile:
        number = self._files + 1
        file = McapFile(numbered(self._path, number))
        self._files = number
        with file.discard_bare():
            for name, document in self._descriptions.items():
                file.attach(name, document, self._now_ns())
        return file

    def _facts(self) -> dict[str, str]:
        """Return the facts of the recording until now, for a file."""
        counts = {"messages": self.messages, "too_slow": self.too_slow, "not_understood": self.not_understood}
        return {name: str(count) for name, count in counts.items()} | self.losses.facts()


def numbered(path: Path, number: int) -> Path:
    """Return a file of a recording: the first has no number."""
    return path if number == 1 else path.with_stem(f"{path.stem}-{number}")


def following(path: Path) -> Path | None:
    """Return the file that goes on where one of a recording ends, if it is beside it."""
    stem, dash, number = path.stem.rpartition("-")
    is_numbered = bool(dash) and number.isdecimal() and path.with_stem(stem).exists()
    found = numbered(path.with_stem(stem), int(number) + 1) if is_numbered else numbered(path, 2)
    return next((each for each in (found, found.with_name(f"{found.name}.part")) if each.exists()), None)


def _is_another(descriptions: Mapping[str, bytes], before: Mapping[str, bytes]) -> bool:
    return descriptions.get(CONFIGURATION) != before.get(CONFIGURATION)
