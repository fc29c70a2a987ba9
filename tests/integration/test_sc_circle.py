"""A host program on the bare simulated wire: three PIC-SERVO SC axes draw a circle in space by path mode.

The host knows the data sheet and nothing of ldcnd: it builds its frames and takes the replies apart itself. The circle
is tilted, so that every axis moves; speed rises and falls along it by a ramp.
"""

import math
from dataclasses import dataclass

import pytest

from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.plant import MotorPlant
from tests.support.rough_host import frame

BAUD = 115_200
CYCLE_S = 0.000512
CYCLES = 32
"""Of a point; nominally 60 Hz."""
BUFFER = 128
PACKET = 7
GROUP = 0x81
MASK = 0xC9
RADIUS = 20_000.0
SPEED = 15.0
"""Counts per servo cycle along the circle, 29,300 counts/s."""
RAMP = 0.02
"""Counts per servo cycle squared."""
U = (1.0, 0.0, 0.0)
V = (0.0, 0.8, 0.6)
"""Two directions at right angles that span the plane of the circle."""
MOST_DEVIATION = 20.0
"""Counts: one servo cycle between the axes' starts (15), the chord of a point (480^2 / 8 r = 1.4), following errors."""
GAINS = bytes.fromhex("5e01 b80b 9001 9001 fa 00 a00f 01 00 01")
AXES = (1, 2, 3)


def on_circle(angle):
    """Return a point of the circle, which begins and ends at the origin."""
    along, across = RADIUS * (math.cos(angle) - 1.0), RADIUS * math.sin(angle)
    return tuple(along * u + across * v for u, v in zip(U, V, strict=True))


def deviation(position):
    """Return how far a point is from the ideal circle, in counts."""
    u = sum(p * e for p, e in zip(position, U, strict=True)) + RADIUS
    v = sum(p * e for p, e in zip(position, V, strict=True))
    in_plane = math.hypot(u, v)
    normal = math.sqrt(max(0.0, sum(p * p for p in position) - (u - RADIUS) ** 2 - v * v))
    return math.hypot(in_plane - RADIUS, normal)


def angles(start, end):
    """Plan the angles at the ends of the points from one angle to another: a ramp up, a slew, a ramp down."""
    way = (end - start) * RADIUS
    ramp_way = min(SPEED**2 / (2 * RAMP), way / 2)
    peak = math.sqrt(2 * RAMP * ramp_way)
    ramp_cycles = peak / RAMP
    total = 2 * ramp_cycles + (way - 2 * ramp_way) / peak
    planned, t = [], 0.0
    while t < total:
        t = min(t + CYCLES, total)
        left = total - t
        if t < ramp_cycles:
            done = 0.5 * RAMP * t * t
        elif left < ramp_cycles:
            done = way - 0.5 * RAMP * left * left
        else:
            done = ramp_way + (t - ramp_cycles) * peak
        planned.append(start + done / RADIUS)
    return planned


@dataclass
class Look:
    """One status of an axis: position, aux byte, position error, points left."""

    position: int
    aux: int
    error: int
    points: int

    @property
    def walks(self):
        return bool(self.aux & 0x40)

    @property
    def commanded(self):
        return self.position + self.error


class CircleHost:
    """Enumerates, closes the loops, forms a group, plans, feeds."""

    def __init__(self, seed):
        plant = MotorPlant(reverse_limit_counts=-60_000, forward_limit_counts=60_000)
        modules = tuple(ModuleSpec("pic-servo-sc", plant) for _ in AXES)
        self.chain = build_chain(ChainSpec(modules, seed=seed))
        self.now_s = 0.0
        self.worst = 0.0
        self.fewest_points = BUFFER
        self.sent_steps = [0, 0, 0]

    def talk(self, address, command, *data, reply=2):
        """Send a packet and wait for its reply, as long as that may take."""
        sent = frame(address, command, *data)
        self.chain.write(self.now_s, sent)
        self.now_s += (len(sent) + reply) * 10 / self.chain.baud + CYCLE_S + 0.0003
        answer = b"".join(piece for _, piece in self.chain.advance(self.now_s))
        self.watch()
        assert len(answer) == reply, (address, command, answer.hex())
        assert sum(answer[:-1]) & 0xFF == answer[-1] if answer else True
        assert not (answer and answer[0] & 0x02)
        return answer

    def watch(self):
        """Look behind the wire: where the three motors really are."""
        position = []
        for module in self.chain.modules:
            module.catch_up(self.now_s)
            position.append(module.shaft.position_counts)
        self.worst = max(self.worst, deviation(position))

    def rest(self, for_s):
        ends_s = self.now_s + for_s
        while self.now_s < ends_s:
            self.now_s += 0.002
            self.chain.advance(self.now_s)
            self.watch()

    def look(self, address, reply=None):
        answer = reply or self.talk(address, 0xE, reply=10)
        signed = [int.from_bytes(answer[a:b], "little", signed=True) for a, b in ((1, 5), (6, 8))]
        return Look(signed[0], answer[5], signed[1], answer[8])

    def bring_up(self):
        for address in AXES:
            self.talk(0, 0x1, address, 0xFF)
        self.talk(0xFF, 0xA, 0x0A, reply=0)
        self.chain.baud = BAUD
        for address in AXES:
            self.talk(address, 0x6, *GAINS)
            self.talk(address, 0x8, 0x00)
            self.talk(address, 0x7, 0x05)
            self.talk(address, 0xB)
            self.talk(address, 0x1, address, 0x01 if address == 1 else GROUP)
            status = self.look(address, self.talk(address, 0x2, MASK, reply=10))
            assert (status.points, status.walks, status.aux & 0x04) == (0, False, 0x04)

    def add(self, targets):
        """Send the same number of points to every axis: rounded targets, minus all that was sent before."""
        for axis, address in enumerate(AXES):
            words = []
            for target in targets:
                step = round(target[axis]) - self.sent_steps[axis]
                self.sent_steps[axis] += step
                words += (abs(step) << 3 | (step < 0)).to_bytes(2, "little")
            status = self.look(address, self.talk(address, 0xD, *words, reply=10))
            assert status.points <= BUFFER

    def draw(self, planned, stall_after=None):
        """Walk through the planned angles; return how many were sent when the path ended, by underrun or at the end."""
        targets = [on_circle(angle) for angle in planned]
        sent = 0
        while sent < min(len(targets), 56):
            self.add(targets[sent : sent + PACKET])
            sent = min(sent + PACKET, len(targets))
        leader = self.look(1, self.talk(GROUP, 0xD, reply=10))
        assert leader.walks
        while True:
            states = [self.look(address) for address in AXES]
            if not any(state.walks for state in states):
                self.rest(2 * CYCLES * CYCLE_S)
                return sent
            fewest = min(state.points for state in states)
            if sent < len(targets):
                self.fewest_points = min(self.fewest_points, fewest)
            stalled = stall_after is not None and sent >= stall_after
            if fewest <= BUFFER // 3 and sent < len(targets) and not stalled:
                self.add(targets[sent : sent + PACKET])
                sent = min(sent + PACKET, len(targets))
            else:
                self.rest(0.01)

    def commanded(self):
        return [self.look(address).commanded for address in AXES]


@pytest.mark.parametrize("seed", [1, 2])
@pytest.mark.sweep(2)
def test_three_axes_draw_a_circle_and_stay_near_it(seed):
    host = CircleHost(seed)
    host.bring_up()

    planned = angles(0.0, math.tau)
    sent = host.draw(planned)
    end = host.commanded()
    host.rest(0.5)

    print(f"seed {seed}: {sent} points, worst deviation {host.worst:.1f} counts of radius {RADIUS:.0f}")
    print(f"seed {seed}: fewest points left {host.fewest_points}")
    assert sent == len(planned)
    assert end == host.sent_steps == [0, 0, 0]
    assert host.fewest_points > 20
    assert 0.1 < host.worst < MOST_DEVIATION
    assert [look.position for look in map(host.look, AXES)] == pytest.approx([0, 0, 0], abs=2)


def test_a_host_that_stalls_underruns_and_goes_on_from_where_the_axes_stopped():
    host = CircleHost(3)
    host.bring_up()
    planned = angles(0.0, math.tau)

    sent = host.draw(planned, stall_after=120)
    stopped = host.commanded()
    reached = planned[sent - 1]
    rest = angles(reached, math.tau)
    finished = host.draw(rest)

    print(f"underrun after {sent} of {len(planned)} points, worst deviation {host.worst:.1f} counts")
    assert 120 <= sent < len(planned)
    assert stopped == [round(target) for target in on_circle(reached)]
    assert finished == len(rest)
    assert host.commanded() == [0, 0, 0]
    assert host.worst < MOST_DEVIATION
    assert all(look.aux & 0x04 for look in map(host.look, AXES))
