"""ROS 2 messages byte by byte, as two other CDR libraries write them (see `make test-edges`), and what they say."""

import asyncio
import struct

import pytest
from zenoh.ext import Int64, z_serialize

from ldcnd.client.rig import Rig
from ldcnd.contract.meta import AxisInfo, AxisLimits
from ldcnd.contract.samples import AxisState, LinkState, Moving, PositionSample, Quality, StateSample
from ldcnd.lab.ros2.bridge import OK, STALE, Bridge, run_bridge
from ldcnd.lab.ros2.cdr import JOINT_STATE
from ldcnd.lab.ros2.graph import RosNode, advertise, attachment_of
from ldcnd.testing.memory_session import MemoryBroker
from tests.support.rig import running_rig, two_axes
from tests.support.ros2_messages import DIAGNOSTICS, JOINTS

AXIS_INFO = AxisInfo(
    axis="x", bus="line0", address=1, family="ldcn", model="ls-182ap", identity=None, unit="mm", counts_per_unit=1000.0,
    direction="forward", limits=AxisLimits(position_min=None, position_max=None, velocity=None, acceleration=None),
    capabilities=(), items=(), adc_full_scale=None,
)  # fmt: skip
BYTES = (
    (
        "0001000000f1536515cd5b070100000000000000010000000200000078000000010000009a9999999999893f0100000000000000000000000000e0"
        "bf00000000"
    ),
    "000100000000000000000000010000000000000000000000000000000000000000000000",
    (
        "000100000500000001000000010000000000000004000000020000006100000003000000626300000400000064656600050000006768696a000000"
        "000400000000000000000000000000f03f0000000000000040000000000000084000000000000010400000000000000000"
    ),
    (
        "0001000000f153650000000001000000000000000100000007000000cea96d6567610000010000000000000095d626e80b2e11be01000000000000"
        "000000000065cdcd4100000000"
    ),
    (
        "0001000000f1536515cd5b07010000000000000001000000000000000700000073696d3a207800000b0000007374616e647374696c6c0000080000"
        "006c696e65302f310000000000"
    ),
    "000100000000000007000000010000000000000000000000",
    (
        "0001000000f1536500000000010000000000000002000000020000000700000073696d3a207900000b0000006572726f725f73746f700000080000"
        "006c696e65302f3200020000000f000000706f736974696f6e5f6572726f7200000f0000006c65667420746865206c696d69740000020000006b00"
        "0000010000000003000001000000000000000100000000000000010000000000000000000000"
    ),
)


@pytest.mark.parametrize(("message", "expected"), list(zip((*JOINTS, *DIAGNOSTICS), BYTES, strict=True)))
def test_messages_are_those_of_other_libraries_byte_by_byte(message, expected):
    assert message.payload.hex() == expected


def test_attachments_are_what_zenoh_s_own_serializer_writes():
    gid = bytes(range(16))
    theirs = b"".join(
        z_serialize(each).to_bytes()
        for each in ("sequence_number", Int64(7), "source_timestamp", Int64(123_456_789), "source_gid", gid)
    )

    assert attachment_of(7, 123_456_789, gid) == theirs


def test_keys_and_tokens_are_those_of_the_design_document():
    node = RosNode(2, "ldcnd_sim", "8b20917502ee955ac4476e0266340d5c")

    assert node.token == "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/0/NN/%/%/ldcnd_sim"  # noqa: S105
    assert node.publisher_token(1, "/joint_states", JOINT_STATE) == (
        "@ros2_lv/2/8b20917502ee955ac4476e0266340d5c/0/1/MP/%/%/ldcnd_sim/%joint_states/"
        "sensor_msgs::msg::dds_::JointState_/"
        "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e/::,10:,:,:,,"
    )
    assert node.topic_key("/joint_states", JOINT_STATE).startswith(
        "2/joint_states/sensor_msgs::msg::dds_::JointState_/"
    )


def test_a_namespace_is_that_of_the_node_and_its_topics():
    node = RosNode(0, "ldcnd_sim", "8b20", "/lab/stage")
    topic = node.topic("joint_states")

    assert node.token == "@ros2_lv/0/8b20/0/0/NN/%/%lab%stage/ldcnd_sim"  # noqa: S105
    assert "/MP/%/%lab%stage/ldcnd_sim/%lab%stage%joint_states/" in node.publisher_token(1, topic, JOINT_STATE)
    assert node.topic_key(topic, JOINT_STATE).startswith(
        "0/lab/stage/joint_states/sensor_msgs::msg::dds_::JointState_/"
    )
    assert RosNode(0, "n", "0").topic("joint_states") == "/joint_states"


async def test_all_joints_are_in_each_message_with_velocities_from_the_first_one():
    published = []
    async with running_rig(two_axes()) as running, running.broker.session() as graph:
        for axis in ("x", "y"):
            await running.until(axis, lambda state: state.link is LinkState.UP)
        rig = Rig(running.client, await running.client.daemon())
        listening = await graph.subscribe("7/**", published.append)
        bridging = asyncio.create_task(run_bridge(rig, graph, (), 7, "/lab"))
        await asyncio.sleep(2)
        bridging.cancel()
        await listening.close()

    joints = [read_joint_state(each.payload) for each in published if each.key.startswith("7/lab/joint_states/")]
    assert len(joints) >= 30  # 20 Hz
    assert {names for names, _, _ in joints} == {("x", "y")}
    assert {(len(positions), len(velocities)) for _, positions, velocities in joints} == {(2, 2)}


def read_joint_state(payload):
    """Return names, positions and velocities of a message; another implementation reads it in `make test-edges`."""
    at = 4 + 8

    def aligned(size):
        nonlocal at
        at += -(at - 4) % size

    def word():
        nonlocal at
        aligned(4)
        at += 4
        return int.from_bytes(payload[at - 4 : at], "little")

    def text():
        nonlocal at
        length = word()
        at += length
        return payload[at - length : at - 1].decode()

    def doubles():
        nonlocal at
        count = word()
        if count:
            aligned(8)
        at += 8 * count
        return struct.unpack(f"<{count}d", payload[at - 8 * count : at])

    text()
    return tuple(text() for _ in range(word())), doubles(), doubles()


def state(t, *, known):
    return StateSample(
        t=t, t_error_ns=0, seq=0, quality=Quality.GOOD, state=AxisState.STANDSTILL, enabled=True, referenced=known,
        moving=Moving.NO, link=LinkState.UP, stop_latched=False, command=None, reference_lost=not known,
    )  # fmt: skip


def place(t, value):
    return PositionSample(
        t=t, t_error_ns=0, seq=0, quality=Quality.GOOD, value=value, unit="mm", counts=0, following_error=None
    )


def homed_bridge():
    bridge = Bridge("sim", {name: AXIS_INFO.model_copy(update={"axis": name}) for name in ("x", "y")})
    for axis in ("x", "y"):
        bridge.take(axis, state(0, known=True), 0.0)
    return bridge


def test_a_joint_whose_place_is_lost_is_left_out_and_not_waited_for():
    bridge = homed_bridge()
    assert bridge.take("x", place(1, 5.0), 0.0) is None
    both = bridge.take("y", place(2, 7.0), 0.0)
    bridge.take("y", state(3, known=False), 0.0)
    bridge.take("y", place(4, 9.0), 0.0)
    alone = bridge.take("x", place(5, 6.0), 0.0)

    assert (both.t, both.names, both.positions) == (2, ("x", "y"), (0.005, 0.007))
    assert (alone.t, alone.names, alone.positions) == (5, ("x",), (0.006,))


def test_what_a_former_run_has_said_of_an_axis_is_over_and_its_clock_too():
    bridge = Bridge("sim", {name: AXIS_INFO.model_copy(update={"axis": name}) for name in ("x", "y")})
    hour_ns = 3600 * 10**9
    for axis in ("x", "y"):
        bridge.take(axis, state(hour_ns, known=True), 0.0, "run 1")
    bridge.take("x", place(hour_ns, 5.0), 0.0, "run 1")
    of_no_state = [bridge.take(axis, place(1, 0.3), 5.0, "run 2") for axis in ("x", "y")]
    bridge.take("x", state(2, known=True), 5.0, "run 2")
    alone = bridge.take("x", place(3, 0.4), 5.0, "run 2")
    levels = {each.name: each.level for each in bridge.diagnostics(0, 5.0).statuses}

    assert of_no_state == [None, None]
    assert (alone.names, alone.positions) == (("x",), (0.0004,))
    assert levels == {"sim: x": OK, "sim: y": STALE}


def test_a_place_that_gets_lost_while_others_are_waited_for_is_in_no_message():
    bridge = homed_bridge()
    bridge.take("y", place(1, 7.0), 0.0)
    bridge.take("y", state(2, known=False), 0.0)
    alone = bridge.take("x", place(3, 6.0), 0.0)

    assert (alone.t, alone.names, alone.positions) == (3, ("x",), (0.006,))


async def test_a_publisher_is_seen_while_it_is_declared():
    seen, published = [], []
    broker = MemoryBroker()
    async with broker.session() as session:
        watching = await session.watch_tokens("@ros2_lv/0/**", lambda key, alive: seen.append((key, alive)))
        node = RosNode(0, "n", "0" * 31 + "1")
        listening = await session.subscribe(
            node.topic_key("/joint_states", JOINT_STATE), lambda sample: published.append(sample.payload)
        )
        publisher, token = await advertise(session, node, 1, "/joint_states", JOINT_STATE)
        publisher.publish(JOINTS[0].payload, JOINTS[0].t)
        await asyncio.sleep(0.1)
        await token.close()
        await asyncio.sleep(0.1)
        await listening.close()
        await watching.close()

    assert [alive for _, alive in seen] == [True, False]
    assert published == [JOINTS[0].payload]


async def test_joint_states_are_in_metres_with_the_time_of_the_drive():
    async with running_rig(two_axes()) as running:
        await running.until("x", lambda state: state.link is LinkState.UP)
        rig = Rig(running.client, await running.client.daemon())
        bridge = Bridge("sim", {info.axis: info for info in await rig.describe() if info.axis == "x"})
        made = []
        async with rig.samples("x") as samples:
            async for axis, sample in samples:
                if message := bridge.take(axis, sample, 0.0):
                    made.append((sample, message))
                if len(made) == 10:  # half a second
                    break
        report = bridge.diagnostics(made[-1][1].t, 0.0)
        later = bridge.diagnostics(made[-1][1].t, 10.0)

    in_micrometres = made[0][0].model_copy(update={"unit": "um"})  # of a daemon with another configuration
    restated = bridge.take("x", in_micrometres, 0.0)
    assert restated
    assert restated.positions == (in_micrometres.value * 1e-6,)
    assert restated.velocities == ()
    assert bridge.take("x", made[0][0].model_copy(update={"unit": "count"}), 0.0) is None
    for sample, message in made:
        assert (message.t, message.names) == (sample.t, ("x",))
        assert message.positions[0] == pytest.approx(sample.value * 1e-3)
    assert {status.name: status.level for status in report.statuses}["sim: x"] == 0
    assert {status.level for status in later.statuses} == {3}
