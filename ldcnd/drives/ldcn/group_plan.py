"""The groups of an LDCN/NMC line: each module has exactly one group address, and one of a group may answer for it.

So what concerns the whole line goes to all addresses in use.
Sources: LS-182AP manual, "Addressing"; PIC-SERVO manual, 4.1 "Group Commands".
"""

from collections.abc import Mapping
from dataclasses import dataclass

from ldcnd.drives.line_config import GroupConfig

EVERYBODY = 0xFF
"""The group address after power-up."""
WAITING_GROUP = 0xFE
"""The group of modules at waiting addresses: no configured group reaches it."""
FIRST_GROUP = 0x81
"""Configured groups are numbered from here; 0x80 is avoided, as its leader's byte would be 0."""


@dataclass(frozen=True, slots=True)
class Group:
    """Modules that share a group address.

    Attributes:
        address: 0x80 to 0xFF.
        members: axis names; for `EVERYBODY` the axes that are in no configured group.
        leader: the member that answers for the group.
    """

    address: int
    members: frozenset[str]
    leader: str | None = None


class GroupPlan:
    """The groups of one line.

    Attributes:
        groups: those that have members, `EVERYBODY` first.
    """

    def __init__(self, groups: tuple[GroupConfig, ...], axes: Mapping[int, str]) -> None:
        configured = tuple(
            Group(FIRST_GROUP + number, frozenset(group.axes), group.leader) for number, group in enumerate(groups)
        )
        others = frozenset(axes.values()).difference(*(group.members for group in configured))
        self.groups = (Group(EVERYBODY, others), *configured) if others else configured
        self._axes = axes

    @property
    def addresses(self) -> tuple[int, ...]:
        """Return every group address that a module may have, `EVERYBODY` first."""
        return (EVERYBODY, *(group.address for group in self.groups if group.address != EVERYBODY))

    def place(self, address: int) -> Group:
        """Return the group of the module at an individual address."""
        name = self._axes.get(address)
        return next((group for group in self.groups if name in group.members), Group(EVERYBODY, frozenset()))

    def leads(self, address: int) -> bool:
        """Tell whether the module at this address answers for its group."""
        leader = self.place(address).leader
        return leader is not None and self._axes.get(address) == leader

    @property
    def leaders(self) -> tuple[int, ...]:
        """Return the addresses of the modules that answer for their groups."""
        return tuple(address for address in self._axes if self.leads(address))

    def exactly(self, names: frozenset[str]) -> Group | None:
        """Return the group with exactly these members: a command to it concerns no other module."""
        return next((group for group in self.groups if group.members == names), None)

    def within(self, names: frozenset[str]) -> tuple[Group, ...]:
        """Return the groups all of whose members are among these."""
        return tuple(group for group in self.groups if group.members <= names)
