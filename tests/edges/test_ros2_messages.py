"""Bytes and type hashes of messages against two other CDR libraries, and tokens as a plain Zenoh client sees them."""

import asyncio
from dataclasses import dataclass

import pytest
import zenoh
from pycdr2 import IdlStruct
from pycdr2.types import float64, int32, sequence, uint8, uint32
from rosbags.typesys import Stores, get_typestore

from ldcnd.ros2.cdr import DIAGNOSTIC_ARRAY, JOINT_STATE, DiagnosticArray, DiagnosticStatus, JointState
from tests.support.process import LDCND, ROOT, daemon, free_port
from tests.support.ros2_messages import DIAGNOSTICS, JOINTS
from tests.support.router import router

pytestmark = pytest.mark.edges
STORE = get_typestore(Stores.ROS2_JAZZY)


@pytest.mark.parametrize(
    ("name", "message"),
    [("sensor_msgs/msg/JointState", JOINT_STATE), ("diagnostic_msgs/msg/DiagnosticArray", DIAGNOSTIC_ARRAY)],
)
def test_type_hashes_are_those_of_the_published_definitions(name, message):
    assert message.type_hash == STORE.hash_rihs01(name)


@pytest.mark.parametrize("message", JOINTS)
def test_rosbags_reads_and_writes_the_same_joint_states(message: JointState):
    read = STORE.deserialize_cdr(message.payload, "sensor_msgs/msg/JointState")

    assert tuple(read.name) == message.names
    assert tuple(read.position) == message.positions
    assert tuple(read.velocity) == message.velocities
    assert read.header.stamp.sec * 10**9 + read.header.stamp.nanosec == message.t
    assert bytes(STORE.serialize_cdr(read, "sensor_msgs/msg/JointState")) == message.payload


@pytest.mark.parametrize("message", DIAGNOSTICS)
def test_rosbags_reads_and_writes_the_same_diagnostics(message: DiagnosticArray):
    read = STORE.deserialize_cdr(message.payload, "diagnostic_msgs/msg/DiagnosticArray")

    assert [status.name for status in read.status] == [status.name for status in message.statuses]
    assert bytes(STORE.serialize_cdr(read, "diagnostic_msgs/msg/DiagnosticArray")) == message.payload


@dataclass
class Time(IdlStruct):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct):
    stamp: Time
    frame_id: str


@dataclass
class Joints(IdlStruct):
    header: Header
    name: sequence[str]
    position: sequence[float64]
    velocity: sequence[float64]
    effort: sequence[float64]


@dataclass
class KeyValue(IdlStruct):
    key: str
    value: str


@dataclass
class Status(IdlStruct):
    level: uint8
    name: str
    message: str
    hardware_id: str
    values: sequence[KeyValue]


@dataclass
class Diagnostics(IdlStruct):
    header: Header
    status: sequence[Status]


def header(t: int) -> Header:
    return Header(Time(t // 10**9, t % 10**9), "")


@pytest.mark.parametrize("message", JOINTS)
def test_pycdr2_writes_the_same_joint_states(message: JointState):
    theirs = Joints(header(message.t), list(message.names), list(message.positions), list(message.velocities), [])

    assert theirs.serialize() == message.payload


@pytest.mark.parametrize("message", DIAGNOSTICS)
def test_pycdr2_writes_the_same_diagnostics(message: DiagnosticArray):
    def of(status: DiagnosticStatus) -> Status:
        values = [KeyValue(*value) for value in status.values]
        return Status(status.level, status.name, status.message, status.hardware_id, values)

    assert Diagnostics(header(message.t), [of(each) for each in message.statuses]).serialize() == message.payload


@pytest.mark.real_time
@pytest.mark.timeout(120)
async def test_a_plain_zenoh_client_sees_node_publishers_and_joint_states():
    graph = f"tcp/127.0.0.1:{free_port()}"
    async with router(graph), daemon(ROOT / "config" / "simulated.toml") as endpoint:
        bridge = await asyncio.create_subprocess_exec(
            *LDCND, "ros2", "x", "y", "-e", endpoint, "--router", graph, "--domain", "3", stdout=-1
        )
        assert bridge.stdout
        assert b"domain 3" in await bridge.stdout.readline()
        tokens, samples = await asyncio.to_thread(look, graph)
        bridge.terminate()
        code = await bridge.wait()

    kinds = sorted(token.split("/")[5] for token in tokens)
    assert kinds == ["MP", "MP", "NN"]
    assert code == 0
    read = STORE.deserialize_cdr(samples[0][0], "sensor_msgs/msg/JointState")
    assert read.name[0] in {"x", "y"}
    assert samples[0][1][:16] == b"\x0fsequence_number"


def look(endpoint: str):
    """Look with Zenoh's own Python package, which knows nothing of ldcnd."""
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", f'["{endpoint}"]')
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        received = session.declare_subscriber(f"3/joint_states/{JOINT_STATE.name}/{JOINT_STATE.type_hash}")
        samples = [(s.payload.to_bytes(), s.attachment.to_bytes()) for s in (received.recv() for _ in range(3))]
        tokens = [str(reply.ok.key_expr) for reply in session.liveliness().get("@ros2_lv/3/**")]
    return tokens, samples
