"""LDCN/NMC: what one side encodes the other side decodes, however the bytes are cut."""

from itertools import pairwise

from hypothesis import given, settings
from hypothesis import strategies as st

from ldcnd.drives.driver import Gains
from ldcnd.drives.ldcn import commands
from ldcnd.drives.ldcn.commands import Node
from ldcnd.drives.ldcn.packet import (
    AuxFlag,
    CommandCode,
    Packet,
    PacketReader,
    ReceivedPacket,
    StatusFlag,
    StatusItem,
    StatusPacket,
    decode_packet,
    decode_status,
    encode_packet,
    encode_status,
)
from ldcnd.drives.ldcn.profiles import PROFILES, Profile, Support
from ldcnd.drives.ldcn.received import LoadTrajectory, SetGain
from ldcnd.drives.ldcn.trajectory import (
    ProfileMode,
    Trajectory,
    acceleration_counts_per_s2,
    programmed_acceleration,
    programmed_velocity,
    velocity_counts_per_s,
)
from tests.support.ldcn_decoding import decode_command

SERVOS = [profile for profile in PROFILES.values() if profile.support is Support.FULL]

packets = st.builds(Packet, st.integers(0, 255), st.sampled_from(CommandCode), st.binary(max_size=15))
profiles = st.sampled_from(SERVOS)
register32 = st.none() | st.integers(0, 0x7FFF_FFFF)
position32 = st.none() | st.integers(-0x7FFF_FFFF, 0x7FFF_FFFF)


@st.composite
def trajectories(draw, profile: Profile):
    servo = draw(st.booleans())
    mode = draw(st.sampled_from(ProfileMode))
    if not servo:
        most = 255
    elif profile.analog_target:
        most = (1 << profile.adc_bits) - 1
    else:
        most = 0
    return Trajectory(
        position=draw(position32),
        velocity=draw(register32),
        acceleration=draw(register32),
        pwm_or_target=draw(st.none() | st.integers(0, most)),
        servo=servo,
        mode=mode,
        reverse=draw(st.booleans()) if not servo or mode is ProfileMode.VELOCITY else False,
        start_now=draw(st.booleans()),
    )


@st.composite
def gains(draw, profile: Profile):
    word = st.integers(0, 0x7FFF)
    byte = st.integers(0, 255)
    return Gains(
        kp=draw(word),
        kd=draw(word),
        ki=draw(word),
        il=draw(word),
        ol=draw(byte),
        cl=draw(byte) if profile.current_limit else 0,
        el=draw(st.integers(0, 0x3FFF)),
        sr=draw(st.integers(1, 255)),
        deadband=draw(byte) if profile.gain_bytes >= 14 else 0,
        step_multiplier=draw(st.integers(1, 255)) if profile.gain_bytes >= 15 else 1,
    )


@st.composite
def statuses(draw, profile: Profile, items: StatusItem):
    def asked(item, values):
        return draw(values) if items & item else None

    word = st.integers(-0x7FFF, 0x7FFF)
    double = st.integers(-0x8000_0000, 0x7FFF_FFFF)
    byte = st.integers(0, 255)
    return StatusPacket(
        StatusFlag(draw(byte)),
        position=asked(StatusItem.POSITION, double),
        adc=asked(StatusItem.ADC, st.integers(0, (1 << profile.adc_bits) - 1)),
        velocity=asked(StatusItem.VELOCITY, word),
        aux=asked(StatusItem.AUX, byte.map(AuxFlag)),
        home=asked(StatusItem.HOME, double),
        device_id=asked(StatusItem.IDENTITY, byte),
        version=asked(StatusItem.IDENTITY, byte),
        position_error=asked(StatusItem.POSITION_ERROR, word) if profile.position_error_bytes else None,
        bit7=asked(StatusItem.BIT7, byte) if profile.bit7_bytes else None,
    )


@given(packets)
def test_a_packet_survives_the_wire(packet):
    assert decode_packet(encode_packet(packet)) == packet


@given(st.lists(st.tuples(packets, st.binary(max_size=4)), max_size=6), st.data())
def test_any_chunking_gives_the_same_packets(sent, data):
    gaps = [(packet, noise.replace(b"\xaa", b"\x00")) for packet, noise in sent]
    stream = b"".join(encode_packet(packet) + noise for packet, noise in gaps)
    cuts = sorted(data.draw(st.sets(st.integers(0, len(stream)))) | {0, len(stream)})
    reader = PacketReader()

    received = [
        packet
        for start, end in pairwise(cuts)
        for packet in [reader.feed(byte) for byte in stream[start:end]]
        if packet is not None
    ]

    assert received == [ReceivedPacket(packet, checksum_ok=True) for packet, _ in gaps]
    assert not reader.in_packet


@given(packets, st.data())
def test_no_changed_byte_behind_the_header_goes_unnoticed(packet, data):
    frame = bytearray(encode_packet(packet))
    at = data.draw(st.sampled_from([i for i in range(1, len(frame)) if i != 2]))
    frame[at] ^= data.draw(st.integers(1, 255))
    reader = PacketReader()

    received = [reader.feed(byte) for byte in frame][-1]

    assert received is not None
    assert not received.checksum_ok


@given(profiles.flatmap(lambda profile: st.tuples(st.just(profile), trajectories(profile))))
def test_a_trajectory_arrives_as_it_was_sent(case):
    profile, trajectory = case

    exchange = commands.load_trajectory(Node(1, profile), trajectory)

    assert decode_command(profile, exchange.request).command == LoadTrajectory(trajectory)
    assert exchange.repeatable is not trajectory.start_now


@given(profiles.flatmap(lambda profile: st.tuples(st.just(profile), gains(profile))))
def test_gains_arrive_as_they_were_sent(case):
    profile, registers = case

    exchange = commands.set_gain(Node(1, profile), registers)

    assert decode_command(profile, exchange.request).command == SetGain(registers)


@given(
    st.tuples(profiles, st.integers(0, 255).map(StatusItem)).flatmap(
        lambda case: st.tuples(st.just(case[0]), st.just(case[1]), statuses(*case))
    )
)
def test_a_status_survives_the_wire(case):
    profile, items, status = case

    data = encode_status(profile, items, status)

    assert commands.read_status(Node(1, profile), items).reply_bytes == len(data)
    assert decode_status(profile, items, data) == status


@settings(max_examples=50)
@given(profiles, st.integers(1, 255), st.floats(1, 1e5))
def test_programmed_values_are_the_nearest(profile, divisor, value):
    velocity = programmed_velocity(value, divisor, profile)
    acceleration = programmed_acceleration(max(value, 100.0), divisor, profile)

    step = velocity_counts_per_s(1, divisor, profile)
    assert abs(velocity_counts_per_s(velocity, divisor, profile) - value) <= step * 0.5000001
    step = acceleration_counts_per_s2(1, divisor, profile)
    back = acceleration_counts_per_s2(acceleration, divisor, profile)
    assert abs(back - max(value, 100.0)) <= step * 0.5000001
