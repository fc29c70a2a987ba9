"""What `ldcnd sim --wire-log` writes about a foreign host."""

from ldcnd.drives.ldcn.packet import PacketReader
from ldcnd.drives.smartstep.packet import CommandCutter, add_parity
from ldcnd.line.capture import parse_capture
from ldcnd.line.flight_recorder import WireEvent
from ldcnd.sim.cli import WireLogFile


def written(path, deeds, family="ldcn", cutter=PacketReader):
    with WireLogFile.open(path, family, cutter(), 19_200) as log:
        for deed, *arguments in deeds:
            getattr(log, deed)(*arguments)
    return parse_capture(path.read_text())


def test_packets_are_records_however_the_host_cuts_them(tmp_path):
    capture = written(
        tmp_path / "host.capture",
        [
            ("sent", 0.1, bytes(3) + bytes.fromhex("aa 00 21"), None),
            ("sent", 0.2, bytes.fromhex("01 ff 21 aa 01 13"), None),
            ("sent", 0.3, bytes.fromhex("20 34 aa 01"), None),
        ],
    )

    assert [record.data.hex() for record in capture.records] == ["000000", "aa002101ff21", "aa01132034", "aa01"]
    assert [record.at_s for record in capture.records] == [0.1, 0.2, 0.3, 0.3]
    assert capture.header.family == "ldcn"


def test_a_packet_that_a_restarting_module_loses_is_remarked_behind_it(tmp_path):
    path = tmp_path / "host.capture"
    deeds = [
        ("sent", 0.1, bytes.fromhex("aa 00 21 01 ff 21"), None),
        ("remarked", "module 1: lost: the module is still resetting"),
    ]
    capture = written(path, deeds)

    assert len(capture.records) == 1
    assert path.read_text().endswith("#   module 1: lost: the module is still resetting\n")


def test_packets_of_a_smartstep_line_are_records_however_the_host_cuts_them(tmp_path):
    path = tmp_path / "host.capture"
    packet = b"W1001020000ED\r"
    deeds = [
        ("sent", 0.1, b"\r" + packet[:5], None),
        ("sent", 0.2, packet[5:] + packet[:3] + packet, None),
        ("received", 0.3, b"W1001020037B6\r"),
        ("sent", 0.4, add_parity(packet), None),
    ]
    capture = written(path, deeds, "smartstep", CommandCutter)

    sent = [record.data for record in capture.records if record.event is WireEvent.SENT]
    assert sent == [b"\r", packet, packet[:3], packet, add_parity(packet)]
    assert path.read_text().count("unit 1: REFERENCE 0102H, 0037H") == 1
    assert path.read_text().count("unit 1: REFERENCE 0102H, 0000H") >= 2


def test_rates_and_replies_are_records_and_packets_are_put_into_words(tmp_path):
    path = tmp_path / "host.capture"
    capture = written(
        path,
        [
            ("sent", 0.0, bytes.fromhex("aa 02 13 20 35"), 19_200),
            ("received", 0.01, bytes.fromhex("00 02 01 03")),
            ("sent", 0.1, bytes.fromhex("aa 02 26 08 00 30"), 19_200),
            ("sent", 0.2, bytes.fromhex("aa 02 0e 10"), 115_200),
        ],
    )

    assert [record.event for record in capture.records] == [
        WireEvent.BAUD,
        WireEvent.SENT,
        WireEvent.RECEIVED,
        WireEvent.SENT,
        WireEvent.BAUD,
        WireEvent.SENT,
    ]
    assert "node 2: SetOutput(levels=8)" in path.read_text()
