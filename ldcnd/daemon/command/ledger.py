"""What became of every command: the same id is carried out at most once, and always answered alike. Pure."""

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass

from ldcnd.daemon.axis.state import ActiveCommand
from ldcnd.errors import CommandIdReused, LdcndError, UnknownCommand
from ldcnd.model.commands import AxisCommand, CommandReply, Verb
from ldcnd.model.events import FINAL, CommandStatus

REMEMBERED = 4096
"""So many commands are remembered; those that are not final are never forgotten."""


@dataclass(frozen=True, slots=True)
class Entry:
    """One command.

    Attributes:
        command: what was asked; a repetition must ask the same.
        client: who asked, as far as that is known.
        login: whose link it came over, if that has a certificate.
        status: how far it has got.
        reason: why it did not end as asked.
        answer: what the caller was told, once he was.
    """

    command_id: str
    axis: str
    command: AxisCommand[CommandReply]
    client: str | None
    login: str | None = None
    status: CommandStatus = CommandStatus.ACCEPTED
    reason: str | None = None
    answer: CommandReply | LdcndError | None = None

    @property
    def verb(self) -> Verb:
        """The verb of the command."""
        return self.command.verb


class Ledger:
    """The commands of one rig, latest last."""

    def __init__(self, changed: Callable[[Entry, LdcndError | None], None]) -> None:
        """Begin empty.

        Args:
            changed: told of every entry and every change of status, with the error that goes with it.
        """
        self._entries: OrderedDict[str, Entry] = OrderedDict()
        self._changed = changed

    def repeated(self, command_id: str, axis: str, command: AxisCommand[CommandReply]) -> Entry | None:
        """Return the entry that this id has already, or None when it is new.

        Raises:
            CommandIdReused: the id belongs to another command.
        """
        entry = self._entries.get(command_id)
        if entry and (entry.axis, entry.verb, _content(entry.command)) != (axis, command.verb, _content(command)):
            raise CommandIdReused(
                f"command id {command_id!r} belongs to {entry.verb} of axis {entry.axis}",
                axis=axis,
                value=command_id,
                remedy="give every command an id of its own",
            )
        return entry

    def get(self, command_id: str) -> Entry:
        """Return an entry.

        Raises:
            UnknownCommand: there is none, or it was forgotten.
        """
        entry = self._entries.get(command_id)
        if entry is None:
            raise UnknownCommand(f"no command {command_id!r} is known", value=command_id, remedy="look at the events")
        return entry

    def open(self, entry: Entry) -> None:
        """Enter a new command."""
        self._entries[entry.command_id] = entry
        if len(self._entries) > REMEMBERED:
            self._forget_one()
        self._changed(entry, None)

    def answered(self, command_id: str, answer: CommandReply | LdcndError, status: CommandStatus) -> None:
        """Note what the caller was told."""
        entry = self._entries.get(command_id)
        if entry is None:
            return
        error = answer if isinstance(answer, LdcndError) else None
        self._reached(entry, answer, status, error.message if error else None, error)

    def reached(
        self, command_id: str, status: CommandStatus, reason: str | None = None, error: LdcndError | None = None
    ) -> None:
        """Note how far a command has got; a final status is kept."""
        if entry := self._entries.get(command_id):
            self._reached(entry, entry.answer, status, reason, error)

    def ended(self, command: ActiveCommand, status: CommandStatus, reason: str | None) -> None:
        """Take from an axis that a command is over."""
        self.reached(command.command_id, status, reason)

    def _reached(
        self,
        entry: Entry,
        answer: CommandReply | LdcndError | None,
        status: CommandStatus,
        reason: str | None,
        error: LdcndError | None,
    ) -> None:
        news = entry.status not in FINAL and entry.status is not status
        if not news:
            status, reason = entry.status, entry.reason
        # spelled out, because `replace` takes 2.0 us instead of 1.3 where the answer waits
        entry = self._entries[entry.command_id] = Entry(
            command_id=entry.command_id,
            axis=entry.axis,
            command=entry.command,
            client=entry.client,
            login=entry.login,
            status=status,
            reason=reason,
            answer=answer,
        )
        if news:
            self._changed(entry, error)

    def _forget_one(self) -> None:
        for command_id, entry in self._entries.items():
            if entry.status in FINAL:
                del self._entries[command_id]
                return


def _content(command: AxisCommand[CommandReply]) -> AxisCommand[CommandReply]:
    """Return what a command asks for, without what only proves that it may."""
    proofs = dict.fromkeys(("client", "lease", "sequence", "instance", "not_after"))
    return command.model_copy(update=proofs)
