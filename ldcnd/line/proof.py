"""Whether the one who answers at an address is the one that is meant: asked when the turn of a packet has come.

The same bytes that set an output of one module start the motor of another, and drives that were not taken over are not
this host's. So a line proves its nodes when it comes up, by what they say they are, and again those that it has lost.
To the others goes only what reads and what takes energy out.
"""

import asyncio
from collections.abc import Callable, Iterable
from contextvars import ContextVar
from typing import Any

from ldcnd.contract.errors import AxisUnreachable, LdcndError, NotIdentified
from ldcnd.line.exchange import Exchange, Lane, PacketEffect

MISSES_UNTIL_LOST = 3
"""Exchanges in a row without a reply after which a node counts as lost: another module may be at its address. So do
replies that cannot be used: what it does is not understood."""
ALWAYS_SENT = frozenset({PacketEffect.READS, PacketEffect.RELIEVES})


Condition = Callable[[], None]
"""Raises what forbids a motion; returns when nothing does."""
_condition: ContextVar[Condition | None] = ContextVar("condition", default=None)


class only_while:  # noqa: N801 - read as a statement
    """Let what changes anything, when queued in this context, be sent only if the condition holds when its turn comes.

    A queue may be long: the condition is checked between it and the wire. Stops are not subject to any condition.
    """

    __slots__ = ("_own", "_token")

    def __init__(self, condition: Condition) -> None:
        self._own = condition

    def __enter__(self) -> None:
        self._token = _condition.set(self._own)

    def __exit__(self, *_raised: object) -> None:
        _condition.reset(self._token)


class bringing_up:  # noqa: N801 - read as a statement
    """Let what hands out addresses, groups and rates, when queued in this context, be sent to any node.

    For the procedures that find out who is where. It is void when the context ends, also for tasks that were created in
    it, and lets nothing else pass.
    """

    __slots__ = ("_token", "holds")

    def __init__(self) -> None:
        self.holds = False

    def __enter__(self) -> None:
        self._token = _pass.set(self)
        self.holds = True

    def __exit__(self, *_raised: object) -> None:
        self.holds = False
        _pass.reset(self._token)


_pass: ContextVar[bringing_up | None] = ContextVar("pass", default=None)


class Proof:
    """What is known of the one who answers at an address.

    Attributes:
        holds: it was identified since the line came up, and was not lost since.
        blocked_by: the silent one before it on its line, without which no address reaches it; empty without one.
    """

    __slots__ = ("_axis", "_problem", "_silent", "_what", "blocked_by", "holds")

    def __init__(self, what: str, axis: str | None) -> None:
        self.holds = False
        self.blocked_by = ""
        self._what, self._axis = what, axis
        self._problem, self._silent = "its line has not come up yet", True

    def prove(self) -> None:
        """Note that it is the one that is meant."""
        self.holds, self.blocked_by = True, ""

    def lose(self, problem: str, *, silent: bool = True) -> None:
        """Note why it is not, or may not be any more.

        Args:
            problem: for people.
            silent: it does not answer; otherwise something answers that is not what is meant, or not this host's.
        """
        self.holds, self._problem, self._silent = False, problem, silent

    @property
    def is_another(self) -> bool:
        """Whether something answers that is not known to be what is meant."""
        return not self.holds and not self._silent

    def refusal(self) -> LdcndError:
        """Return the refusal of what would change something: `AxisUnreachable` if it is silent, or `NotIdentified`."""
        if self._silent:
            before = f", nor does {self.blocked_by} before it" if self.blocked_by else ""
            return AxisUnreachable(
                f"{self._what}: the drive does not answer: {self._problem}{before}",
                axis=self._axis,
                remedy=f"check the power of {self.blocked_by} first"
                if self.blocked_by
                else "check its power and the line",
            )
        return NotIdentified(
            f"{self._what} is not identified, so only what stops it is sent: {self._problem}",
            axis=self._axis,
            remedy="correct the wiring or the configuration; the line is tried again by itself",
        )


class Proofs:
    """The proofs of one line.

    Attributes:
        heard_again: set when a node answers that was lost: it can be identified.
    """

    def __init__(self) -> None:
        self.heard_again = asyncio.Event()
        self._nodes: dict[int, Proof] = {}
        self._groups: dict[int, tuple[Proof, ...]] = {}

    def expect(self, node: int, what: str, axis: str | None = None) -> Proof:
        """Return the proof of a node that the configuration names; it begins without.

        Args:
            node: its address.
            what: it is, for people.
            axis: its name, if it is one.
        """
        proof = self._nodes.get(node)
        if proof is None:
            proof = self._nodes[node] = Proof(what, axis)
        return proof

    def expect_group(self, address: int, members: Iterable[int]) -> None:
        """Let what goes to an address require the proofs of all these nodes."""
        self._groups[address] = tuple(self._nodes[member] for member in members)

    def all_hold(self) -> bool:
        """Tell whether every node is proven."""
        return all(proof.holds for proof in self._nodes.values())

    def lose_all(self, problem: str, *, silent: bool = True) -> None:
        """Lose the proofs of all nodes, see `Proof.lose`."""
        for proof in self._nodes.values():
            proof.lose(problem, silent=silent)

    def missed(self, node: int, misses: int) -> None:
        """Note how many exchanges in a row a node has left unanswered."""
        # one that is lost already keeps its reason: that it restarted, or that another module is there, says more
        if misses >= MISSES_UNTIL_LOST and (proof := self._nodes.get(node)) and proof.holds:
            proof.lose(f"address {node} has stopped answering")

    def answered(self, node: int) -> None:
        """Take note that a node answers which had not answered before."""
        # it may be another module by now, so its answer is no proof: it only says that there is one to identify
        if (proof := self._nodes.get(node)) and not proof.holds:
            self.heard_again.set()

    def check(self, node: int) -> None:
        """Refuse what would change something at an address, of a node or of a group.

        Raises:
            AxisUnreachable, NotIdentified: see `Proof.refusal`, of the first one that lacks its proof.
        """
        # of an address that several share the weakest proof counts: all execute the packet (PIC-SERVO manual, 4.1)
        proofs = (self._nodes[node],) if node in self._nodes else self._groups.get(node)
        if not proofs:
            raise NotIdentified(
                f"address {node} is not configured, so nothing that could change anything is sent there", value=node
            )
        for proof in proofs:
            if not proof.holds:
                raise proof.refusal()

    def condition(self, exchange: Exchange[Any], lane: Lane) -> Condition:
        """Return what is checked when the turn of an exchange comes that is queued in this context.

        That is its proof, and the permission of a command (`only_while`), which a stop does not need.
        """
        permission = _condition.get() if lane is not Lane.STOP else None
        passes = _pass.get() if exchange.effect is PacketEffect.ARRANGES else None

        def condition() -> None:
            # a bring-up is freed from the proof, which it is about to find, and not from the caller's permission
            if not (passes and passes.holds):
                self.check(exchange.node)
            if permission:
                permission()

        return condition
