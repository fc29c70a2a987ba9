"""Bytes and type hashes of messages against two other CDR libraries, and tokens as other programs see them."""

import asyncio
import os
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
import zenoh
from pycdr2 import IdlStruct
from pycdr2.types import float64, int32, sequence, uint8, uint32
from rosbags.typesys import Stores, get_typestore

from ldcnd.lab.ros2.cdr import DIAGNOSTIC_ARRAY, JOINT_STATE, DiagnosticArray, DiagnosticStatus, JointState
from tests.support.process import ROOT, daemon, free_port, process
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


@asynccontextmanager
async def bridged() -> AsyncIterator[str]:
    """Run a daemon, the router of a graph and the bridge between them, in domain 3; yields the router's endpoint."""
    graph = f"tcp/127.0.0.1:{free_port()}"
    async with (
        router(graph),
        daemon(ROOT / "config" / "simulated.toml") as endpoint,
        process("ros2", "x", "y", "-e", endpoint, "--router", graph, "--domain", "3") as bridge,
    ):
        assert bridge.stdout
        assert b"domain 3" in await bridge.stdout.readline()
        yield graph
        bridge.terminate()
        assert await bridge.wait() == 0


@pytest.mark.real_time
@pytest.mark.timeout(300)
async def test_a_plain_zenoh_client_sees_node_publishers_and_joint_states():
    async with bridged() as graph:
        tokens, samples = await asyncio.to_thread(look, graph)

    kinds = sorted(token.split("/")[5] for token in tokens)
    assert kinds == ["MP", "MP", "NN"]
    read = STORE.deserialize_cdr(samples[0][0], "sensor_msgs/msg/JointState")
    assert read.name == ["x", "y"]
    assert samples[0][1][:16] == b"\x0fsequence_number"


SUBSCRIBER = """
import queue
import sys

from zenoh_ros2_sdk import ROS2Subscriber
from zenoh_ros2_sdk.session import ZenohSession

port, type_hash = int(sys.argv[1]), sys.argv[2]
session = ZenohSession.get_instance("127.0.0.1", port)
session.register_message_type("int32 sec\\nuint32 nanosec", "builtin_interfaces/msg/Time")
session.register_message_type("builtin_interfaces/Time stamp\\nstring frame_id", "std_msgs/msg/Header")
fields = "std_msgs/Header header\\nstring[] name\\nfloat64[] position\\nfloat64[] velocity\\nfloat64[] effort"
taken = queue.Queue()
kind = "sensor_msgs/msg/JointState"
ROS2Subscriber("/joint_states", kind, taken.put, fields, domain_id=3, router_port=port, type_hash=type_hash)
for _ in range(10):
    message = taken.get(timeout=60)
    assert (list(message.name), len(message.position), len(message.velocity)) == (["x", "y"], 2, 2), message
    assert max(map(abs, message.position)) < 1e-4, message
session.close()
"""


@pytest.mark.real_time
@pytest.mark.timeout(300)
async def test_another_implementation_of_the_protocol_lists_the_topics_and_reads_them(tmp_path):
    async def said(*command: str) -> str:
        run = await asyncio.create_subprocess_exec(*command, stdout=-1, env={**os.environ, "HOME": str(tmp_path)})
        printed, _ = await run.communicate()
        assert run.returncode == 0
        return printed.decode()

    async with bridged() as graph:
        tool = (str(Path(sys.executable).parent / "zenoh-ros2"), "--no-daemon", "--timeout", "20", "--domain-id", "3")
        tool = (*tool, "--router", graph.removeprefix("tcp/"), "topic")
        listed = await said(*tool, "list", "-t", "-v")
        info = await said(*tool, "info", "-v", "/joint_states")
        await said(sys.executable, "-c", SUBSCRIBER, graph.rpartition(":")[2], JOINT_STATE.type_hash)

    assert "/joint_states [sensor_msgs/msg/JointState] 1 publisher" in listed
    assert "/diagnostics [diagnostic_msgs/msg/DiagnosticArray] 1 publisher" in listed
    assert "Node name: ldcnd_sim" in info
    assert JOINT_STATE.type_hash in info


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
