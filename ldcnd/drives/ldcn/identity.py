"""Who is at an address of an LDCN/NMC line, and whether that is whom the configuration expects there.

Sources: LS-182AP manual, "Define Status", item 5; PIC-SERVO manual, 5.2.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from ldcnd.contract.errors import BadReply
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.packet import StatusItem, StatusPacket, decode_status
from ldcnd.drives.ldcn.profiles import PIC_SERVO_V4, Profile, identify
from ldcnd.line.exchange import Exchange

ANY_DIALECT = PIC_SERVO_V4
"""Status byte and identity are laid out alike everywhere, so any profile reads them."""
UNADDRESSED = Node(0, ANY_DIALECT)
"""The first module of the chain that has no address yet."""


@dataclass(frozen=True, slots=True)
class Identity:
    """A module's identification; 0 to 255 each."""

    device_id: int
    version: int

    @property
    def profile(self) -> Profile | None:
        """The dialect of this pair; None for an unsupported device."""
        return identify(self.device_id, self.version)

    def __str__(self) -> str:
        """Return a title for people."""
        profile = self.profile
        return f"{profile.title if profile else 'an unknown device'} (id {self.device_id}, version {self.version})"


@dataclass(frozen=True, slots=True)
class Expected:
    """The module that the configuration expects at an address.

    Attributes:
        address: 1 to 127.
        what: the axis it is, for messages.
        profile: the dialect spoken with it.
        identity: accepted although it is not among the profile's own.
    """

    address: int
    what: str
    profile: Profile
    identity: Identity | None = None

    def accepts(self, found: Identity) -> bool:
        """Tell whether this identity may be spoken with as configured."""
        return found == self.identity or found.profile == self.profile

    def differs(self, found: Identity | None) -> str | None:
        """Return in words how what was found differs; None when it does not."""
        if found is not None and self.accepts(found):
            return None
        return f"address {self.address} ({self.what}): expected {self.profile.title}, found {found or 'nothing'}"


def differences(expected: tuple[Expected, ...], found: Mapping[int, Identity]) -> tuple[str, ...]:
    """Return in words what is missing or something else, by address."""
    said = (each.differs(found.get(each.address)) for each in expected)
    return tuple(difference for difference in said if difference)


def read_identity(address: int, known: Identity | None = None) -> Exchange[StatusPacket]:
    """Return the exchange that reads id and version, and insists on the known ones if they are given."""
    exchange = commands.read_status(Node(address, ANY_DIALECT), StatusItem.IDENTITY)
    if known is None:
        return exchange

    def decode(data: bytes) -> StatusPacket:
        status = decode_status(ANY_DIALECT, StatusItem.IDENTITY, data)
        if identity_in(status) != known:
            raise BadReply(f"node {address} says {identity_in(status)}, known as {known}")
        return status

    return replace(exchange, decode=decode)


def identity_in(status: StatusPacket) -> Identity:
    """Return the identity that a status packet carries."""
    return Identity(status.device_id or 0, status.version or 0)
