"""The simulation of the toy family: stages that move at constant velocity."""

from pydantic import Field
from typing_extensions import override

from ldcnd.contract.frozen import Frozen
from ldcnd.line.exchange import NEVER_S
from ldcnd.line.transport import Opener
from ldcnd.sim.chain import Chain, Module, ModuleReply
from ldcnd.sim.family import SimulatedFamily
from ldcnd.sim.line import open_simulated_line
from ldcnd.sim.line_config import FaultyLineConfig
from tests.toy.family import BAUD, FRAME, FRAME_BYTES, REPLY, REQUEST, RESPONSE_S, Flag, Op, ToyBusConfig, frame


class SimulatedStage(Module):
    """A stage that moves at constant velocity."""

    baud = float(BAUD)
    yields_to_host = False

    def __init__(self, node: int) -> None:
        self._node = node
        self._heard = bytearray()
        self._replies: list[ModuleReply] = []
        self._enabled = False
        self._from = self._to = 0
        self._loaded = (0, 1)
        self._velocity = 1
        self._began_s = 0.0

    def hear(self, value: int | None, at_s: float) -> None:
        self._heard.append(value or 0)
        if self._heard[0] != REQUEST:
            self._heard.clear()
        if len(self._heard) < FRAME_BYTES:
            return
        packet, self._heard = bytes(self._heard), bytearray()
        _head, node, op, position, velocity = FRAME.unpack(packet[:-1])
        if node != self._node or sum(packet[:-1]) & 0xFF != packet[-1]:
            return
        self._obey(Op(op), position, velocity, at_s)
        now = self._position(at_s)
        moves = now != self._to
        flags = (Flag.ENABLED if self._enabled else 0) | (0 if moves else Flag.AT_REST)
        speed = 0 if not moves else self._velocity if self._to > now else -self._velocity
        self.next_event_s = at_s + RESPONSE_S / 2
        self._replies.append(ModuleReply(frame(REPLY, node, flags, now, speed), self.next_event_s, 10 / BAUD))

    def advance(self, to_s: float) -> ModuleReply | None:
        if not self._replies or self._replies[0].starts_at_s > to_s:
            return None
        reply = self._replies.pop(0)
        self.next_event_s = self._replies[0].starts_at_s if self._replies else NEVER_S
        return reply

    def _obey(self, op: Op, position: int, velocity: int, at_s: float) -> None:
        if op in {Op.ENABLE, Op.DISABLE}:
            self._enabled = op is Op.ENABLE
        if op in {Op.STOP, Op.DISABLE}:
            self._from = self._to = self._position(at_s)
        if op is Op.LOAD:
            self._loaded = position, max(1, velocity)
        if op is Op.START and self._enabled:
            self._from, self._began_s = self._position(at_s), at_s
            self._to, self._velocity = self._loaded

    def _position(self, at_s: float) -> int:
        gone = round(self._velocity * (at_s - self._began_s))
        if gone >= abs(self._to - self._from):
            return self._to
        return self._from + (gone if self._to > self._from else -gone)


class SimulatedStageConfig(Frozen):
    """One simulated stage."""

    node: int = Field(ge=1, le=9)
    """Its address."""


class SimulatedToyLineConfig(FaultyLineConfig):
    """A simulated line of stages."""

    stage: tuple[SimulatedStageConfig, ...] = Field(min_length=1, max_length=9)
    """The drives of the line."""


class SimulatedToys(SimulatedFamily[ToyBusConfig, SimulatedToyLineConfig]):
    """The toys."""

    line_config = SimulatedToyLineConfig
    key = "stage"

    @override
    def chain(self, line: SimulatedToyLineConfig, settings: ToyBusConfig, starts_at_s: float) -> Chain:
        chain = Chain([SimulatedStage(each.node) for each in line.stage], line.faults(starts_at_s))
        chain.baud = BAUD
        return chain

    @override
    def opener(self, chain: Chain, settings: ToyBusConfig) -> Opener:
        return lambda: open_simulated_line(chain)


SIMULATED_TOYS = SimulatedToys()
