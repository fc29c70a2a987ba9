"""Where an LDCN/NMC packet goes and what comes back from there: one answering module, or a silent group.

Sources: LS-182AP manual, "Addressing"; PIC-SERVO manual, "Group Commands".
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import partial
from typing import Generic, TypeVar

from ldcnd.drivers.ldcn.fields import GROUP_ADDRESS
from ldcnd.drivers.ldcn.packet import MOST_ADDRESS
from ldcnd.drivers.ldcn.profiles import Profile, Support
from ldcnd.drivers.ldcn.registers import SERVO_CYCLE_S
from ldcnd.drivers.ldcn.status import STATUS_BYTE_ONLY, Status, StatusItem, check_status, status_bytes, status_decoder
from ldcnd.errors import NotSupported, ValueOutOfRange
from ldcnd.exchange import Exchange, ReplyVerdict

ReplyT = TypeVar("ReplyT")


class Destination(ABC, Generic[ReplyT]):
    """Who takes a packet, and with what type of reply.

    Attributes:
        address: the address byte.
        profile: the dialect of everyone concerned; None when it is not known.
    """

    __slots__ = ()

    address: int
    profile: Profile | None

    @abstractmethod
    def exchange(self, request: bytes, items: StatusItem | None, *, repeatable: bool) -> Exchange[ReplyT]:
        """Pair a request with its reply: these status items, or those sent by default when None."""


@dataclass(frozen=True, slots=True)
class Node(Destination[Status]):
    """One module, or a group whose leader answers as if it had been meant alone.

    Attributes:
        address: 0 (no address yet) to 127; 128 to 255 for a group with a leader.
        profile: the dialect of whoever answers; in a group the others share it as far as the command depends on it.
        items: what it adds to every reply, that is, the mask of the last Define Status.
    """

    address: int
    profile: Profile
    items: StatusItem = STATUS_BYTE_ONLY

    def __post_init__(self) -> None:
        """Refuse an address that does not fit its byte."""
        if not 0 <= self.address <= MOST_ADDRESS:
            raise ValueOutOfRange(
                f"node address {self.address} is outside 0 to {MOST_ADDRESS}", value=self.address, limit=MOST_ADDRESS
            )

    def exchange(self, request: bytes, items: StatusItem | None, *, repeatable: bool) -> Exchange[Status]:
        """See `Destination`.

        Raises:
            NotSupported: of this module nothing but status byte and identity can be decoded.
        """
        asked = self.items if items is None else items
        if self.profile.support is Support.IDENTIFY and asked & ~StatusItem.IDENTITY:
            raise NotSupported(f"{self.profile.title}: only status byte and identity can be decoded, not {asked!r}")
        reply_bytes = status_bytes(self.profile, asked)
        rejected_bytes = status_bytes(self.profile, self.items)
        return Exchange(
            node=self.address,
            request=request,
            reply_bytes=reply_bytes,
            check=check_status,
            decode=status_decoder(self.profile, asked),
            response_s=SERVO_CYCLE_S,
            repeatable=repeatable,
            total_bytes=None if asked == self.items else partial(_total_bytes, rejected_bytes, reply_bytes),
        )


@dataclass(frozen=True, slots=True)
class Group(Destination[None]):
    """All modules of a group without a leader: nobody answers, and the line rests until the command is executed.

    Attributes:
        address: 0x80 to 0xFF.
        profile: the dialect that all members share; needed only for what not every dialect has alike.
    """

    address: int
    profile: Profile | None = None

    def __post_init__(self) -> None:
        """Refuse what is not a group address."""
        GROUP_ADDRESS.check(self.address)

    def exchange(self, request: bytes, items: StatusItem | None, *, repeatable: bool) -> Exchange[None]:  # noqa: ARG002
        """See `Destination`; the manuals ask for 0.51 ms of quiet."""
        return unanswered(self.address, request, SERVO_CYCLE_S, repeatable=repeatable)


def _total_bytes(rejected_bytes: int, reply_bytes: int, data: bytes) -> int:
    """A module that rejects a packet has not read which items it asked for: it answers with those of its default."""
    return rejected_bytes if data[0] & 0x02 else reply_bytes  # StatusFlag.CHECKSUM_ERROR


def unanswered(address: int, request: bytes, quiet_s: float, *, repeatable: bool) -> Exchange[None]:
    """Return an exchange that draws no reply and keeps the line quiet for a while."""
    return Exchange(
        node=address,
        request=request,
        reply_bytes=0,
        check=_unexpected,
        decode=_nothing,
        response_s=quiet_s,
        repeatable=repeatable,
    )


def _unexpected(_data: bytes) -> ReplyVerdict:
    return ReplyVerdict.CORRUPT


def _nothing(_data: bytes) -> None:
    return None
