"""The Wireshark dissector, by tshark, against ldcnd's own decoders, on the captures that are kept."""

import asyncio
import json
import shutil
import subprocess
from pathlib import Path

import pytest
from click.testing import CliRunner

from ldcnd.cli import wire_log
from ldcnd.config.rig import load_config
from ldcnd.daemon.capture import config_of
from ldcnd.drives.ldcn.packet import CommandCode, PacketReader, StatusItem, StatusPacket, decode_status, status_bytes
from ldcnd.drives.ldcn.profiles import PROFILES
from ldcnd.drives.smartstep.packet import PACKET_CHARACTERS, decode_command, decode_reply
from ldcnd.line.capture import Capture, parse_capture
from ldcnd.line.flight_recorder import WireEvent, WireRecord
from ldcnd.ops.dissector import FILE, PERSONAL_PLUGINS, dissector, install
from ldcnd.ops.pcapng import encode_pcapng
from tests.support.captures import FOLDER, NAMES
from tests.support.rig import SIMULATED, running_rig

TSHARK = shutil.which("tshark") or ""
needs_tshark = pytest.mark.skipif(not TSHARK, reason="no tshark: apt-get install tshark")
OF_LDCN = """address command checksum_ok request reply status position velocity adc home position_error device_id
    version aux dialect"""
OF_SMARTSTEP = "unit address data checksum_ok request"
FIELDS = (
    "frame.number",
    *(f"ldcn.{name}" for name in OF_LDCN.split()),
    *(f"smartstep.{name}" for name in OF_SMARTSTEP.split()),
)


def dissected(records: tuple[WireRecord, ...], folder: Path) -> list[dict[str, list[str]]]:
    """Return the fields of each packet, as tshark has them in its second pass."""
    (folder / FILE).write_text(dissector(), encoding="utf-8")
    (folder / "line.pcapng").write_bytes(encode_pcapng(records, "line0", 0))
    wanted = (word for name in FIELDS for word in ("-e", name))
    command = (TSHARK, "-2", "-n", "-X", f"lua_script:{folder / FILE}", "-r", str(folder / "line.pcapng"), "-T", "json")
    done = subprocess.run(  # noqa: S603 - tshark on our own files
        [*command, *wanted],
        capture_output=True,
        text=True,
        check=True,
        timeout=50,
        env={"HOME": str(folder), "PATH": "/usr/bin:/bin"},
    )
    assert "Lua" not in done.stderr, done.stderr
    return [packet["_source"]["layers"] for packet in json.loads(done.stdout)]


def kept(name: str) -> Capture:
    return parse_capture((FOLDER / f"{name}.capture").read_text(encoding="utf-8"))


def statuses(capture: Capture) -> dict[int, tuple[int, StatusPacket]]:
    """Return address and status of each reply to a Read Status that came whole, by the number of its record."""
    models = {axis.address: axis.model for axis in config_of(capture.header).bus[0].axis}
    found: dict[int, tuple[int, StatusPacket]] = {}
    asked: tuple[int, StatusItem] | None = None
    for number, record in enumerate(capture.records, 1):
        if record.event is WireEvent.SENT:
            reader = PacketReader()
            packets = [read.packet for byte in record.data if (read := reader.feed(byte))]
            last = packets[-1] if packets else None
            reads = last and last.command is CommandCode.READ_STATUS and last.address in models
            asked = (last.address, StatusItem(last.data[0])) if last and reads else None
        elif record.event is WireEvent.RECEIVED and asked:
            profile = PROFILES[models[asked[0]]]
            if len(record.data) == status_bytes(profile, asked[1]) and not record.note:
                found[number] = (asked[0], decode_status(profile, asked[1], record.data))
            asked = None
        elif record.event is WireEvent.TIMEOUT:
            asked = None
    return found


@needs_tshark
@pytest.mark.real_time
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.sweep(2)
def test_every_status_says_what_our_own_decoder_says(name: str, tmp_path: Path):
    capture = kept(name)

    packets = dissected(capture.records, tmp_path)

    known = {}
    for number, (address, status) in statuses(capture).items():
        shown = packets[number - 1]
        assert shown["ldcn.address"] == [str(address)]
        assert int(shown["ldcn.status"][0], 16) == status.flags
        if status.device_id is not None:
            known[address] = (status.device_id, status.version)
            assert (shown["ldcn.device_id"], shown["ldcn.version"]) == ([str(status.device_id)], [str(status.version)])
        if address not in known:
            continue
        for item in ("position", "adc", "home", "position_error"):
            if (value := getattr(status, item)) is not None:
                assert shown[f"ldcn.{item}"] == [str(value)], (number, item)
        if status.velocity is not None:
            assert abs(int(shown["ldcn.velocity"][0])) == abs(status.velocity)
        assert shown["ldcn.dialect"]
    assert len(known) > 1
    assert len(packets) == len(capture.records)


@needs_tshark
@pytest.mark.real_time
@pytest.mark.long
def test_requests_and_replies_are_paired_and_damage_is_shown(tmp_path: Path):
    packets = dissected(kept("corrupted_line").records, tmp_path)

    paired = [packet for packet in packets if packet.get("ldcn.request")]
    for packet in paired:
        asked = packets[int(packet["ldcn.request"][0]) - 1]
        assert asked["ldcn.reply"] == packet["frame.number"]
        assert packet["ldcn.address"] == asked["ldcn.address"][-1:]
    assert len(paired) > 50
    assert any(packet.get("ldcn.checksum_ok") in (["0"], ["False"]) for packet in paired)


@needs_tshark
@pytest.mark.real_time
@pytest.mark.long
def test_smartstep_packets_have_their_fields(tmp_path: Path):
    records = asyncio.run(smartstep_records(tmp_path))

    packets = dissected(records, tmp_path)

    compared = 0
    for record, shown in zip(records, packets, strict=True):
        if record.event is WireEvent.SENT and (command := decode_command(record.data)):
            expected = (command.unit, command.address, command.data)
        elif record.event is WireEvent.RECEIVED and len(record.data) == PACKET_CHARACTERS:
            reply = decode_reply(record.data)
            expected = (reply.unit, reply.address, reply.data)
            assert shown["smartstep.request"]
        else:
            continue
        compared += 1
        numbers = [shown[f"smartstep.{name}"][0] for name in ("unit", "address", "data")]
        assert tuple(int(number, 0) for number in numbers) == expected
        assert shown["smartstep.checksum_ok"][0] in ("1", "True")
    assert compared > 50


async def smartstep_records(folder: Path) -> tuple[WireRecord, ...]:
    config = load_config(SIMULATED.with_name("mixed.toml")).model_copy(update={"state_dir": folder})
    async with running_rig(config) as rig:
        await asyncio.sleep(3.0)
        return tuple(next(line for line in rig.daemon.rig.buses if line.family == "smartstep").bus.wire_log.records())


def test_plugin_is_installed_where_wireshark_looks_for_it(tmp_path: Path):
    assert install(tmp_path) == tmp_path / PERSONAL_PLUGINS / FILE
    assert (tmp_path / PERSONAL_PLUGINS / FILE).read_text(encoding="utf-8") == dissector()


def test_command_installs_it_without_a_line_or_a_daemon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HOME", str(tmp_path))

    done = CliRunner().invoke(wire_log.command, ["--dissector"])

    assert (done.exit_code, done.output) == (0, f"{tmp_path / PERSONAL_PLUGINS / FILE}\n")


@pytest.mark.parametrize("name", [command.name for command in CommandCode])
def test_every_command_of_the_manuals_has_its_name(name: str):
    assert f'] = "{name}"' in dissector()
