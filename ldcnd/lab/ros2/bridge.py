"""The bridge: what a rig publishes becomes joint states and diagnostics. Nothing goes the other way."""

import asyncio
import secrets
import time
from collections.abc import Mapping
from contextlib import AsyncExitStack

from ldcnd.client.daemon_clock import DaemonClock
from ldcnd.client.network import Session
from ldcnd.client.rig import Rig
from ldcnd.contract.condition import SILENT_S, Alarm, Place, assess
from ldcnd.contract.meta import AxisInfo
from ldcnd.contract.samples import (
    FaultSample,
    PositionSample,
    Sample,
    StateSample,
    TelemetryItem,
    VelocitySample,
)
from ldcnd.contract.units import si
from ldcnd.lab.ros2.cdr import DIAGNOSTIC_ARRAY, JOINT_STATE, DiagnosticArray, DiagnosticStatus, JointState
from ldcnd.lab.ros2.graph import RosNode, RosPublisher, advertise

FRESH_NS = 200_000_000
"""Maximum age of a velocity relative to the position that it accompanies."""
PERIOD_S = 1.0
"""Between two reports on all axes, in seconds."""
OK, WARN, ERROR, STALE = range(4)
LEVELS = {Alarm.NONE: OK, Alarm.MINOR: WARN, Alarm.MAJOR: ERROR, Alarm.INVALID: ERROR}
NOT_REPORTED = "its state is not reported any more"


class Bridge:
    """The axes of a rig, as messages.

    Attributes:
        axes: what they are, by name.
    """

    def __init__(self, rig: str, axes: Mapping[str, AxisInfo]) -> None:
        self._rig = rig
        self.axes = axes
        self._velocities: dict[str, VelocitySample] = {}
        self._round: dict[str, PositionSample] = {}  # since the last message; its axis may have lost its place since
        self._states: dict[str, StateSample] = {}
        self._faults: dict[str, FaultSample] = {}
        self._clock = DaemonClock()

    def take(self, axis: str, sample: Sample, at_s: float, run: str | None = None) -> JointState | None:
        """Take a sample; return the state of all joints that it completes, if it is a position that was measured.

        Joints of which nothing is known, and axes that have none, are not waited for.

        Args:
            axis: whose.
            sample: of it.
            at_s: when it came here, in loop time.
            run: the run of the daemon that says it; None where that is not known.
        """
        if self._clock.follow(run or ""):  # what a former run has said is over
            self._states, self._faults, self._velocities, self._round = {}, {}, {}, {}
        self._clock.note(sample.t, at_s)
        match sample:
            case VelocitySample():
                self._velocities[axis] = sample
            case StateSample():
                self._states[axis] = sample
            case FaultSample():
                self._faults[axis] = sample
            case PositionSample() if si(sample.unit) and self._is_known(axis, sample):
                made = self._joints() if axis in self._round else None  # of a joint that is late: it is in the next one
                self._round[axis] = sample
                if made is None and self._round.keys() >= self._awaited():
                    made = self._joints()
                return made
        return None

    def _awaited(self) -> set[str]:
        """Return the axes whose places are known, and which have therefore a position in each round."""
        return {
            name
            for name, info in self.axes.items()
            if si(info.unit)  # axes in other units have no joint
            and name in self._states
            and assess(self._states[name], self._faults.get(name)).place is Place.KNOWN
        }

    def _joints(self) -> JointState | None:
        """Return the positions of a round that are places now, and the velocities if there is one of each joint."""
        awaited = self._awaited()
        positions = {name: sample for name, sample in self._round.items() if name in awaited}
        self._round = {}
        if not positions:
            return None
        names = tuple(name for name in self.axes if name in positions)
        scales = [
            si(positions[name].unit) or 1.0 for name in names
        ]  # of the daemon that has measured it, not as described
        velocities = [self._velocity(name, positions[name]) for name in names]
        known = tuple(each * scale for each, scale in zip(velocities, scales, strict=True) if each is not None)
        return JointState(
            max(sample.t for sample in positions.values()),
            names,
            tuple(positions[name].value * scale for name, scale in zip(names, scales, strict=True)),
            known if len(known) == len(names) else (),
        )

    def _velocity(self, axis: str, position: PositionSample) -> float | None:
        velocity = self._velocities.get(axis)
        if velocity is None or velocity.unit != f"{position.unit}/s" or abs(position.t - velocity.t) > FRESH_NS:
            return None
        return velocity.value

    def diagnostics(self, now_ns: int, now_s: float) -> DiagnosticArray:
        """Return a report on every axis, at an instant in UTC and in loop time."""
        return DiagnosticArray(now_ns, tuple(self._status(name, now_s) for name in self.axes))

    def _is_known(self, axis: str, sample: PositionSample) -> bool:
        """Tell whether a position says where the axis is: a joint state has no place for a reservation."""
        condition = assess(self._states.get(axis), self._faults.get(axis), position_quality=sample.quality)
        return condition.place is Place.KNOWN

    def _status(self, axis: str, now_s: float) -> DiagnosticStatus:
        info, state, faults = self.axes[axis], self._states.get(axis), self._faults.get(axis)
        active = faults.active if faults else ()
        is_old = state is not None and self._clock.age_s(state.t, now_s) > SILENT_S
        condition = assess(state, faults, silence=NOT_REPORTED if is_old else "")
        values = (
            ("place", condition.place.value),
            ("control", condition.control or "unknown"),
            *((fault.code, fault.text) for fault in active),
            *((trouble.short, trouble.text) for trouble in condition.troubles),
        )
        level = STALE if state is None or is_old else LEVELS[condition.alarm]
        message = condition.summary
        return DiagnosticStatus(level, f"{self._rig}: {axis}", message, f"{info.bus}/{info.address}", values)


async def run_bridge(rig: Rig, session: Session, axes: tuple[str, ...], domain: int, namespace: str = "/") -> None:
    """Publish until cancelled.

    Args:
        rig: the rig.
        session: with the router of the ROS graph.
        axes: which axes; all of them when none is named.
        domain: the ROS domain.
        namespace: of the node and its topics.
    """
    infos = {info.axis: info for info in await rig.describe() if not axes or info.axis in axes}
    bridge = Bridge(rig.name, infos)
    node = RosNode(domain, f"ldcnd_{rig.name}", secrets.token_hex(16), namespace)
    async with AsyncExitStack() as declared:
        declared.push_async_callback((await session.declare_token(node.token)).close)
        publishers: list[RosPublisher] = []
        for entity, (topic, message) in enumerate(
            ((node.topic("joint_states"), JOINT_STATE), ("/diagnostics", DIAGNOSTIC_ARRAY)), 1
        ):
            publisher, token = await advertise(session, node, entity, topic, message)
            declared.push_async_callback(token.close)
            publishers.append(publisher)
        async with asyncio.TaskGroup() as group:
            group.create_task(_joints(rig, bridge, publishers[0]), name="joint states")
            group.create_task(_descriptions(rig, bridge, axes), name="descriptions")
            group.create_task(_diagnostics(bridge, publishers[1]), name="diagnostics")


async def _descriptions(rig: Rig, bridge: Bridge, axes: tuple[str, ...]) -> None:
    async for infos in rig.follow_descriptions():
        bridge.axes = {name: info for name, info in infos.items() if not axes or name in axes}


async def _joints(rig: Rig, bridge: Bridge, publisher: RosPublisher) -> None:
    now_s = asyncio.get_running_loop().time
    async with rig.samples() as samples:
        for axis in bridge.axes:
            for item in (TelemetryItem.STATE, TelemetryItem.FAULT, TelemetryItem.VELOCITY):
                last = await rig.latest(axis, item)
                if last:
                    bridge.take(
                        axis, last, now_s(), rig.client.run
                    )  # a first message waits for no change, and has velocities
        async for axis, sample in samples:
            if axis in bridge.axes and (message := bridge.take(axis, sample, now_s(), rig.client.run)):
                publisher.publish(message.payload, message.t)


async def _diagnostics(bridge: Bridge, publisher: RosPublisher) -> None:
    while True:
        await asyncio.sleep(PERIOD_S)
        now_ns, now_s = time.time_ns(), asyncio.get_running_loop().time()
        publisher.publish(bridge.diagnostics(now_ns, now_s).payload, now_ns)
