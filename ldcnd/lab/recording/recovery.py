"""Saves what a recording that was cut short, or damaged, still holds."""

from dataclasses import dataclass
from pathlib import Path

from mcap.records import Attachment, Channel, McapRecord, Message, Metadata, Schema
from mcap.writer import Writer

from ldcnd.lab.recording.mcap_file import FACTS, Losses, part_of, start_writer
from ldcnd.lab.recording.reading import Damage, Recording


@dataclass(frozen=True, slots=True)
class Recovered:
    """The result of a recovery.

    Attributes:
        messages: how many.
        last_ns: when the last of them came, UTC in ns since 1970; 0 without any.
        damages: what could not be read.
        losses: what is missing between the messages that were saved.
    """

    messages: int
    last_ns: int
    damages: tuple[Damage, ...]
    losses: Losses


def recover(damaged: Path, whole: Path) -> Recovered:
    """Copy what can be read of a file into a whole one.

    Raises:
        ConfigError: `damaged` is no recording; `whole` exists already, or the beginning of it.
        OSError: a file cannot be read or written.
    """
    recording = Recording(damaged)
    part = part_of(whole)
    with part.open("xb") as target:
        copy = _Copy(start_writer(target))
        try:
            for record in recording.records():
                copy.add(record)
        except BaseException:
            part.unlink()
            raise
        copy.finish(recording)
    part.rename(whole)
    return Recovered(copy.messages, copy.last_ns, tuple(recording.damages), copy.losses)


class _Copy:
    """The whole file while it is written."""

    def __init__(self, writer: Writer) -> None:
        self.messages = 0
        self.last_ns = 0
        self.losses = Losses()
        self._writer = writer
        self._schemas: dict[int, int] = {0: 0}
        self._channels: dict[int, int] = {}
        self._topics: dict[int, str] = {}
        self._has_facts = False

    def add(self, record: McapRecord) -> None:
        """Copy one record; indexes are rebuilt."""
        match record:
            case Schema() if record.id not in self._schemas:
                self._schemas[record.id] = self._writer.register_schema(record.name, record.encoding, record.data)
            case Channel() if record.id not in self._channels:
                self._topics[record.id] = record.topic
                self._channels[record.id] = self._writer.register_channel(
                    record.topic, record.message_encoding, self._schemas[record.schema_id], record.metadata
                )
            case Attachment():
                self._writer.add_attachment(
                    record.create_time, record.log_time, record.name, record.media_type, record.data
                )
            case Metadata():
                self._has_facts = self._has_facts or record.name == FACTS
                self._writer.add_metadata(record.name, record.metadata)
            case Message():
                self._message(record)

    def finish(self, recording: Recording) -> None:
        """End the file; one that was cut short gets the facts that its recorder could not write any more."""
        if not self._has_facts:
            damages = {f"damage {number}": str(damage) for number, damage in enumerate(recording.damages, 1)}
            facts = {"messages": str(self.messages), "recovered_from": recording.path.name, **damages}
            self._writer.add_metadata(FACTS, facts | self.losses.facts())
        self._writer.finish()  # type: ignore[no-untyped-call] # the package leaves its result open

    def _message(self, record: Message) -> None:
        channel = self._channels[record.channel_id]
        self._writer.add_message(channel, record.log_time, record.data, record.publish_time, record.sequence)
        self.losses.saw(self._topics[record.channel_id], record.sequence)
        self.messages += 1
        self.last_ns = max(self.last_ns, record.log_time)
