"""Requests and replies of real hardware: what simulated modules make of the requests, and decoders of the replies."""

import json
from dataclasses import replace
from pathlib import Path

import pytest

from ldcnd.drives.ldcn.commands import Node, no_operation, set_address
from ldcnd.drives.ldcn.packet import CommandCode, StatusItem, check_status, decode_status, encode_status
from ldcnd.drives.ldcn.pic_io import (
    IoItem,
    SetDirection,
    SetOutput,
    decode_io_status,
    encode_io_command,
    encode_io_status,
)
from ldcnd.drives.ldcn.profiles import LS_231, PIC_IO, PIC_SERVO_V4, SK_2310G2, identify
from ldcnd.drives.ldcn.received import SetAddress
from ldcnd.line.exchange import ReplyVerdict
from ldcnd.sim.ldcn.chain import ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.power import FaultCondition
from ldcnd.sim.ldcn.simulation import SimulationConfig
from ldcnd.sim.plant import MotorPlant
from tests.support.ldcn_decoding import decode_command
from tests.support.simulated_axis import SimulatedAxis
from tests.support.simulated_host import PATIENCE_S, SimulatedHost

EXCHANGES = json.loads((Path(__file__).parents[1] / "vectors" / "real-exchanges.json").read_text())
PROFILES = {"VSpin PIC-SERVO": PIC_SERVO_V4, "VSpin PIC-I/O": PIC_IO, "LS-231SE": LS_231, "SK-2310g2": SK_2310G2}
DIFFERENT = {
    "VSpin PIC-SERVO": "position, home, A/D value, phases of an earlier move: those of a real rotor, see below",
    "VSpin PIC-I/O": "levels and A/D value: those of a real cabinet, see below",
    "LS-231SE": "status byte: its flags are not described, and only its identity is simulated",
    "SK-2310g2": "inputs and A/D values: those of a real machine",
}
"""Bytes of a reply that a simulated module cannot know. It does know the length, the checksum and the identity."""
ONLY_WHAT_IT_KNOWS = {("SK-2310g2", mask) for mask in (0, 8, 32)}
"""Exchanges whose replies hold nothing else."""
TWO_MASK_BYTES = 0x100
"""Define Status of an SK-2310g2 takes a second byte, whose first bit adds items that only it has."""


def simulated(device):
    """Return a host with one module of this kind."""
    return SimulatedHost(build_chain(ChainSpec((ModuleSpec(PROFILES[device].name),))))


def ordered(device):
    return [each for each in EXCHANGES if each["device"] == device]


@pytest.mark.parametrize("device", PROFILES)
def test_a_simulated_module_answers_the_requests_of_real_ones_in_order_as_far_as_it_can_know(device):
    assert device in DIFFERENT
    host = simulated(device)
    (module,) = host.chain.modules
    for exchange in ordered(device):
        request, reply, mask = bytes.fromhex(exchange["request"]), bytes.fromhex(exchange["reply"]), exchange["mask"]
        if request[1] == 0:
            host.send(module.address, CommandCode.HARD_RESET)
        elif module.address != request[1]:
            host.send(module.address, CommandCode.SET_ADDRESS, request[1], 0xFF)
        if mask >= TWO_MASK_BYTES:
            host.send(module.address, CommandCode.DEFINE_STATUS, mask & 0xFF, mask >> 8)
            continue
        if "WITHOUT a data byte" in exchange["note"]:
            host.send(module.address, CommandCode.DEFINE_STATUS)
        elif mask:
            host.send(module.address, CommandCode.DEFINE_STATUS, mask)

        host.chain.write(host.now_s, request)
        answer = host.wait(0.03)

        assert len(answer) == len(reply), exchange["note"]
        assert check_status(answer) is ReplyVerdict.INTACT, exchange["note"]
        if mask & StatusItem.IDENTITY:
            identity = bytes((module.profile.device_id, module.settings.version))
            assert reply.index(identity) == answer.index(identity)
        if (device, mask) in ONLY_WHAT_IT_KNOWS:
            assert answer == reply, exchange["note"]


@pytest.mark.parametrize("exchange", EXCHANGES, ids=lambda each: f"{each['device']} {each['reply']}")
def test_every_reply_of_real_modules_is_taken(exchange):
    reply, mask, profile = bytes.fromhex(exchange["reply"]), exchange["mask"], PROFILES[exchange["device"]]

    assert check_status(reply) is ReplyVerdict.INTACT
    if profile is PIC_IO or (profile is SK_2310G2 and 0 < mask < TWO_MASK_BYTES and mask != StatusItem.IDENTITY):
        decode_io_status(IoItem(mask), reply)  # an SK-2310g2 has the items of a PIC-I/O in their widths
    elif mask < TWO_MASK_BYTES:
        decode_status(PIC_SERVO_V4, StatusItem(mask), reply)


@pytest.mark.parametrize(
    "exchange", ordered("VSpin PIC-SERVO") + ordered("VSpin PIC-I/O"), ids=lambda each: each["reply"]
)
def test_what_a_real_module_says_is_sent_with_its_bytes(exchange):
    reply, mask = bytes.fromhex(exchange["reply"]), exchange["mask"]

    if PROFILES[exchange["device"]] is PIC_IO:
        assert encode_io_status(IoItem(mask), decode_io_status(IoItem(mask), reply)) == reply
    else:
        said = decode_status(PIC_SERVO_V4, StatusItem(mask), reply)
        assert encode_status(PIC_SERVO_V4, StatusItem(mask), said) == reply


@pytest.mark.parametrize("exchange", EXCHANGES, ids=lambda each: f"{each['device']} {each['request']}")
def test_every_request_to_real_modules_has_all_its_bytes_and_is_sent_with_the_same(exchange):
    profile, request = PROFILES[exchange["device"]], bytes.fromhex(exchange["request"])
    meant = decode_command(profile, request)
    match meant.command:
        case SetAddress(address, group, leader):
            sent = set_address(Node(0, profile), address, group, leader=leader).request
        case SetOutput():
            sent = encode_io_command(request[1], meant.command)
        case _:
            sent = no_operation(Node(request[1], profile)).request

    assert not meant.oddities
    assert sent == request


def test_a_simulated_door_answers_with_the_bytes_of_a_real_one_while_it_opens():
    pin, opens, unlocks = 9, 10, 11
    sensors = [{"line": 5, "between": [0.25, 0.9]}, {"line": 7, "between": [1, 1]}]
    door = {"name": "door", "module": 1, "output": opens, "travel_s": 4.0, "sensors": sensors}
    module = {"model": "pic-io", "io": {"low": [1, 2, 3, 6]}}
    host = SimulatedHost(build_chain(SimulationConfig.model_validate({"module": [module], "part": [door]}).spec()))
    host.address_all()

    def answer(*high):
        host.chain.write(host.now_s, encode_io_command(1, SetOutput(sum(1 << line - 1 for line in high))))
        host.wait(PATIENCE_S)
        return host.send(1, CommandCode.NO_OPERATION).hex()

    host.chain.write(host.now_s, encode_io_command(1, SetDirection(0x8DF)))
    host.wait(PATIENCE_S)
    host.send(1, CommandCode.DEFINE_STATUS, IoItem.LEVELS | IoItem.ADC1)
    answers = [answer(pin, unlocks)]
    for for_s in (0.5, 1.0, 3.5):
        answers.append(answer(pin, unlocks, opens))
        host.wait(for_s)

    assert [*answers[:2], *answers[3:], answer(pin, unlocks, opens)] == [
        each["reply"] for each in EXCHANGES if each["note"].startswith("door")
    ]


def test_a_simulated_rotor_that_lost_its_power_at_the_index_answers_as_a_real_one_but_for_its_current():
    exchange = EXCHANGES[0]
    plant = MotorPlant(counts_per_rev=8000, index_at_counts=0x2522 - 8000, index_width_counts=10)
    rotor = SimulatedAxis("pic-servo-v4", plant=plant)
    rotor.send(1, CommandCode.RESET_POSITION)
    rotor.move(0x5E0)
    rotor.finish()
    rotor.wait(1.0)
    rotor.send(1, CommandCode.SAVE_CURRENT_POSITION_AS_HOME)
    rotor.move(0x2522)
    rotor.finish()
    rotor.wait(1.0)
    rotor.suffer(FaultCondition.MOTOR_POWER_OFF)
    rotor.send(1, CommandCode.DEFINE_STATUS, exchange["mask"])
    rotor.chain.write(rotor.now_s, bytes.fromhex(exchange["request"]))
    items = StatusItem(exchange["mask"])

    shown = decode_status(PIC_SERVO_V4, items, rotor.wait(PATIENCE_S))

    assert replace(shown, adc=0x4F) == decode_status(PIC_SERVO_V4, items, bytes.fromhex(exchange["reply"]))


def test_the_real_replies_say_what_their_devices_showed():
    servo = decode_status(PIC_SERVO_V4, StatusItem(0x1F), bytes.fromhex("11222500004f000018e0050000a4"))
    io = [decode_io_status(IoItem(3), bytes.fromhex(reply)) for reply in ("00080d0015", "00c80f00d7")]
    supervisor = decode_status(PIC_SERVO_V4, StatusItem.IDENTITY, bytes.fromhex("00023436"))

    assert (servo.position, servo.home, servo.velocity, servo.adc) == (0x2522, 0x5E0, 0, 0x4F)
    assert servo.position - servo.home == 8002
    assert [status.levels for status in io] == [0xD08, 0xFC8]
    assert identify(supervisor.device_id, supervisor.version) is SK_2310G2


def test_define_status_without_its_byte_takes_what_set_address_left_in_the_receive_buffer():
    host = simulated("SK-2310g2")
    (module,) = host.chain.modules
    host.send(0, CommandCode.SET_ADDRESS, 6, 0xFF)
    host.send(6, CommandCode.NO_OPERATION)

    host.send(6, CommandCode.DEFINE_STATUS)
    short = module.items
    host.send(6, CommandCode.DEFINE_STATUS, 0xFF, 0xFF)
    host.send(6, CommandCode.DEFINE_STATUS)

    assert (short, module.items) == (StatusItem(0x06), StatusItem(0xFF))
