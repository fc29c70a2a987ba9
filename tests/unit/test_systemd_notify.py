"""The daemon and its service manager, on the jumping clock; only the datagrams are real."""

import asyncio
import os
import socket
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from ldcnd.client.events import latest_events
from ldcnd.client.rig import Rig
from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import RigConfig, load_config
from ldcnd.contract.commands import MoveAbsolute, MoveVelocity, Power
from ldcnd.contract.errors import ConfigError, VelocityLimit, WrongState
from ldcnd.contract.rig_commands import Reload
from ldcnd.contract.samples import AxisState, Moving, PositionSample, TelemetryItem
from ldcnd.contract.sequences import NamedPosition
from ldcnd.daemon.assembly import build_daemon
from ldcnd.daemon.daemon import Daemon
from ldcnd.daemon.service import Service, describe
from ldcnd.drives.axis_config import AxisConfig, LossConfig, LossPolicy
from ldcnd.line.line import Phase
from ldcnd.systemd import Notifier, reloading, status
from ldcnd.testing.memory_session import MemoryBroker
from tests.support.rig import EPOCH_NS, SIMULATED

WATCHDOG_S = 5.0


class Manager:
    """The service manager's end."""

    def __init__(self, place: Path) -> None:
        self.socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        self.socket.bind(str(place))
        self.environment = {
            "NOTIFY_SOCKET": str(place),
            "WATCHDOG_USEC": str(int(WATCHDOG_S * 1e6)),
            "WATCHDOG_PID": str(os.getpid()),
        }

    async def listen(self, seconds: int) -> list[str]:
        """Return what comes within this time; the kernel keeps only a few datagrams, so they are fetched at once."""
        messages = self.heard()
        for _ in range(10 * seconds):
            await asyncio.sleep(0.1)
            messages += self.heard()
        return messages

    def heard(self) -> list[str]:
        """Return the datagrams that have come since the last call."""
        messages = []
        while True:
            try:
                messages.append(self.socket.recv(4096).decode())
            except BlockingIOError:
                return messages


@pytest.fixture
def manager(tmp_path: Path) -> Iterator[Manager]:
    manager = Manager(tmp_path / "notify")
    yield manager
    manager.socket.close()


@asynccontextmanager
async def service_of(
    manager: Manager, load: Callable[[], RigConfig] = lambda: load_config(SIMULATED), config: RigConfig | None = None
) -> AsyncIterator[tuple[Service, Daemon, RigClient]]:
    """Run the simulated rig as a service until the context ends."""
    config = config or load_config(SIMULATED)
    loop = asyncio.get_running_loop()
    broker = MemoryBroker()
    async with broker.session() as session, broker.session() as client_session, asyncio.TaskGroup() as group:
        daemon = build_daemon(config, session, lambda: EPOCH_NS + round(loop.time() * 1e9), "test")
        service = Service(daemon, Notifier(manager.environment), load, lambda: 1_234_567_890)
        running = group.create_task(service.run(), name="service")
        try:
            yield service, daemon, RigClient(client_session, config.rig)
        finally:
            service.end()
            await running


def with_axis(config: RigConfig, name: str, **changes: object) -> RigConfig:
    """Return the configuration with some keys of an axis changed."""

    def changed(axis: AxisConfig) -> AxisConfig:
        return axis.model_copy(update=changes) if axis.name == name else axis

    buses = tuple(bus.model_copy(update={"axis": tuple(map(changed, bus.axis))}) for bus in config.bus)
    return config.model_copy(update={"bus": buses})


# -- the protocol ----------------------------------------------------------------------------------------------------


def test_messages_travel_as_one_datagram(manager: Manager):
    Notifier(manager.environment).tell("READY=1", status("drei Würfel\nund ≥ 2 Achsen"))

    assert manager.heard() == ["READY=1\nSTATUS=drei Würfel und ≥ 2 Achsen"]


def test_abstract_addresses_work(manager: Manager):
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as abstract:
        abstract.bind(f"\0ldcnd-test-{os.getpid()}")

        Notifier({"NOTIFY_SOCKET": f"@ldcnd-test-{os.getpid()}"}).tell("READY=1")

        assert abstract.recv(64) == b"READY=1"


def test_reload_says_when_on_the_monotonic_clock():
    assert reloading(1_234_567_890) == "RELOADING=1\nMONOTONIC_USEC=1234567"


def test_without_a_manager_nothing_is_told_and_nothing_fails(tmp_path: Path):
    Notifier({}).tell("READY=1")
    Notifier({"NOTIFY_SOCKET": str(tmp_path / "gone")}).tell("READY=1")

    assert not Notifier({}).is_heard


@pytest.mark.parametrize(
    ("environment", "watchdog_s"),
    [
        ({}, None),
        ({"WATCHDOG_USEC": "5000000"}, 5.0),
        ({"WATCHDOG_USEC": "5000000", "WATCHDOG_PID": str(os.getpid())}, 5.0),
        ({"WATCHDOG_USEC": "5000000", "WATCHDOG_PID": "1"}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
    ],
)
def test_watchdog_is_fed_only_by_the_process_that_is_watched(environment: dict[str, str], watchdog_s: float | None):
    assert Notifier(environment).watchdog_s == watchdog_s


# -- the service -----------------------------------------------------------------------------------------------------


async def test_ready_comes_first_and_stopping_last(manager: Manager):
    async with service_of(manager) as (_, daemon, _client):
        await daemon.wait_up()
        messages = await manager.listen(2)

    messages += manager.heard()
    assert messages[0] == "STATUS=starting"
    assert messages[1].startswith("READY=1\nSTATUS=rig sim: 0/1 buses, 0/4 axes up; line0: the line is not up: ")
    assert any("STATUS=rig sim: 1/1 buses, 4/4 axes up" in message for message in messages)
    assert messages[-2:] == ["STOPPING=1\nSTATUS=stopping: axes come to rest", "STATUS=stopped; all axes at rest"]


@pytest.mark.long
async def test_watchdog_is_fed_well_within_its_time(manager: Manager):
    async with service_of(manager) as (_, daemon, _client):
        await daemon.wait_up()
        manager.heard()

        fed = sum("WATCHDOG=1" in message for message in await manager.listen(20))
    assert fed >= 20 / WATCHDOG_S * 2


async def test_watchdog_starves_while_a_line_has_lost_its_deadline(manager: Manager):
    async with service_of(manager) as (_, daemon, _client):
        await daemon.wait_up()
        line = daemon.rig.buses[0].bus._line
        assert line
        while line.phase is not Phase.REPLY:
            await asyncio.sleep(0.0001)
        line._watchdog.cancel()
        line._transaction = None  # whatever comes is a stray: the line waits for ever
        await asyncio.sleep(1)
        manager.heard()

        messages = await manager.listen(10)
    assert not any("WATCHDOG=1" in message for message in messages)


async def test_status_says_which_bus_has_missed_its_deadline(manager: Manager):
    async with service_of(manager) as (_, daemon, _client):
        await daemon.wait_up()
        bus = daemon.rig.buses[0].bus
        bus.on_time = lambda _now_s: False  # type: ignore[method-assign]

        assert (await manager.listen(4))[-1].endswith("bus line0 has missed its deadline")


async def test_port_that_is_not_there_is_told_and_does_not_starve_the_watchdog(manager: Manager):
    config = load_config(SIMULATED)
    gone = config.bus[0].model_copy(update={"port": "/dev/ldcn-is-not-there"})
    async with service_of(manager, config=config.model_copy(update={"bus": (gone,)})) as (_, daemon, _client):
        fed = sum("WATCHDOG=1" in message for message in await manager.listen(60))
        text = describe(daemon.rig)

    assert text.startswith("rig sim: 0/1 buses, 0/4 axes up; line0: the line is not up: ")
    assert "/dev/ldcn-is-not-there" in text
    assert fed >= 60 / WATCHDOG_S * 2


async def test_what_is_true_of_several_axes_is_said_once_and_a_latched_stop_is_told(manager: Manager):
    async with service_of(manager) as (_, daemon, client):
        await daemon.wait_up()
        for axis in ("x", "y"):
            await client.stop(axis)
        async with asyncio.timeout(30):
            while "4/4 axes up" not in (text := describe(daemon.rig)):
                await asyncio.sleep(0.1)

    assert text == "rig sim: 1/1 buses, 4/4 axes up; x, y: a stop is latched: nothing moves before reset"


async def test_end_brings_a_moving_axis_to_rest(manager: Manager):
    async with service_of(manager) as (service, daemon, client):
        await daemon.wait_up()
        await asyncio.sleep(1)
        await client.command("x", Power(on=True))
        await client.command("x", MoveAbsolute(position=90))
        await manager.listen(1)
        assert daemon.rig.axes["x"].tracker.status.state is AxisState.DISCRETE_MOTION

        service.end()
        said = await manager.listen(3)

        assert daemon.rig.axes["x"].tracker.status.state is not AxisState.DISCRETE_MOTION
        assert said[-1] == "STATUS=stopped; all axes at rest"


async def test_the_last_word_names_what_was_left_moving(manager: Manager):
    loss = LossConfig(daemon=LossPolicy.RUN_TO_TARGET)
    async with service_of(manager, config=with_axis(load_config(SIMULATED), "x", loss=loss)) as (
        service,
        daemon,
        client,
    ):
        await daemon.wait_up()
        await manager.listen(2)
        await client.command("x", Power(on=True))
        await client.command("x", MoveAbsolute(position=90))
        await manager.listen(1)
        service.end()

        assert (await manager.listen(5))[-1] == "STATUS=stopped; still moving: x"


async def test_the_last_word_claims_nothing_of_drives_that_did_not_answer(manager: Manager):
    async with service_of(manager) as (service, daemon, _client):
        await daemon.wait_serving()
        service.end()

        assert (await manager.listen(5))[-1] == "STATUS=stopped; not known whether it moves: x, y, z, c"


# -- reloading -------------------------------------------------------------------------------------------------------


async def test_reload_is_framed_and_changes_limits_at_once(manager: Manager):
    config = load_config(SIMULATED)
    slower = config.bus[0].axis[0].limits.model_copy(update={"velocity": 5.0})
    changed = with_axis(config, "x", limits=slower, velocity=4.0)
    async with service_of(manager, lambda: changed) as (service, daemon, client):
        await daemon.wait_up()
        await asyncio.sleep(1)
        await client.command("x", Power(on=True))
        manager.heard()

        service.reload()

        messages = [message for message in await manager.listen(1) if message != "WATCHDOG=1"]
        with pytest.raises(VelocityLimit):
            await client.command("x", MoveAbsolute(position=1, velocity=6))
        reply = await client.command("x", MoveAbsolute(position=1))
    assert messages[0] == "RELOADING=1\nMONOTONIC_USEC=1234567"
    assert messages[1].startswith("READY=1\nSTATUS=rig sim: 1/1 buses")
    assert reply.velocity == pytest.approx(4.0, rel=0.01)


async def test_a_client_is_shown_what_a_reload_changes_and_gets_that(manager: Manager):
    config = load_config(SIMULATED)
    gains = config.bus[0].axis[0].gains.model_copy(update={"kp": 351})
    files = [with_axis(config, "x", velocity=4.0, gains=gains)]
    async with service_of(manager, lambda: files[-1]) as (_, daemon, client):
        await daemon.wait_up()
        rig = Rig(client, await client.daemon())
        shown = await rig.reload(dry_run=True)
        info = next(each for each in await rig.describe() if each.axis == "x")
        files.append(with_axis(files[-1], "x", velocity=3.0))
        with pytest.raises(WrongState, match="changed again"):
            await rig.reload(revision=shown.revision)
        files.pop()
        done = await rig.reload(revision=shown.revision)
        taken = daemon.config.bus[0].axis[0]
        again = await rig.reload()
        told = [(each.axis, each.reason) for each in await latest_events(client, 100) if each.verb == "reload"]

    assert told == [("x", "velocity 20 mm/s -> 4 mm/s")]
    assert not shown.applied
    assert info.axis == "x"
    assert [(each.key, each.before, each.after, each.restart) for each in shown.changes] == [
        ("bus.line0.axis.x.velocity", "20 mm/s", "4 mm/s", False),
        ("bus.line0.axis.x.gains.kp", "350", "351", True),
    ]
    assert done.applied
    assert done.changes == shown.changes
    assert (taken.velocity, taken.gains.kp) == (4.0, 350)
    assert not again.applied
    assert again.lines() == ["bus.line0.axis.x.gains.kp: 350 -> 351 (needs a restart of the daemon)"]


async def test_an_axis_that_another_client_controls_keeps_its_settings_and_the_rest_is_taken(manager: Manager):
    config = load_config(SIMULATED)
    place = NamedPosition(name="park", axes={"x": 1.0})
    file = with_axis(with_axis(config, "x", velocity=4.0), "y", velocity=3.0).model_copy(update={"position": (place,)})
    async with service_of(manager, lambda: file) as (_, daemon, client):
        await daemon.wait_up()
        rig = Rig(client, await client.daemon())
        async with rig.control("x", client="ann"):
            shown = await client.ask(Reload(dry_run=True))
            done = await client.ask(Reload(revision=shown.revision))
            x, y, *_ = daemon.config.bus[0].axis
            assert (x.velocity, y.velocity, daemon.config.position) == (config.bus[0].axis[0].velocity, 3.0, (place,))
            told = {each.axis for each in await latest_events(client, 100) if each.verb == "reload"}
            again = await client.ask(Reload(dry_run=True))
            await rig.reload()  # hers
            assert daemon.config == file

    assert {(each.key, each.held_by, each.restart) for each in shown.changes} == {
        ("position.park", None, False),
        ("bus.line0.axis.x.velocity", "ann", False),
        ("bus.line0.axis.y.velocity", None, False),
    }
    assert done.changes == shown.changes
    assert "bus.line0.axis.x.velocity: 20 mm/s -> 4 mm/s (not taken: ann controls axis x)" in shown.lines()
    assert done.lines()[-1] == "reloaded; what is not taken, or needs a restart, stays as it is"
    assert told == {"y"}
    assert [each.key for each in again.changes] == ["bus.line0.axis.x.velocity"]


async def test_a_file_that_makes_no_configuration_is_refused_and_the_daemon_goes_on(manager: Manager):
    def load() -> RigConfig:
        raise ConfigError("bus[0].axis[0].velocity: must be above 0")

    async with service_of(manager, load) as (_, daemon, client):
        await daemon.wait_up()
        with pytest.raises(ConfigError, match="must be above 0"):
            await Rig(client, await client.daemon()).reload()

        assert daemon.config == load_config(SIMULATED)


async def test_reload_does_not_touch_a_motion(manager: Manager):
    config = load_config(SIMULATED)
    changed = with_axis(config, "x", velocity=1.0)
    async with service_of(manager, lambda: changed) as (service, daemon, client):
        await daemon.wait_up()
        await asyncio.sleep(1)
        await client.command("x", Power(on=True))
        await client.command("x", MoveAbsolute(position=20))

        service.reload()
        await asyncio.sleep(2)

        sample = await client.last("x", TelemetryItem.POSITION)
    assert isinstance(sample, PositionSample)
    assert sample.value == pytest.approx(20, abs=0.1)  # at 20 units a second, as it was started


async def test_reload_changes_the_rates_of_a_line_that_is_up(manager: Manager):
    config = load_config(SIMULATED)
    rates = config.bus[0].axis[0].rates.model_copy(update={"position": 1.0, "velocity": 1.0, "adc": 0.0, "state": 1.0})
    changed = config
    for axis in config.bus[0].axis:
        changed = with_axis(changed, axis.name, rates=rates)
    async with service_of(manager, lambda: changed) as (service, daemon, _client):
        await daemon.wait_up()
        await asyncio.sleep(2)
        statistics = daemon.rig.buses[0].bus.statistics

        service.reload()
        await asyncio.sleep(1)
        before = statistics.replies
        await asyncio.sleep(10)

        assert 30 <= statistics.replies - before <= 60  # 4 axes, once a second


async def test_reload_names_what_needs_a_restart(manager: Manager):
    config = load_config(SIMULATED)
    other = config.bus[0].model_copy(update={"port": "/dev/ldcn-other"})
    async with service_of(manager, lambda: config.model_copy(update={"bus": (other,)})) as (service, daemon, _client):
        await daemon.wait_up()

        service.reload()

        messages = await manager.listen(2)
        assert any(message.endswith("restart needed for bus.line0.port") for message in messages)
        assert daemon.config == config


async def test_wrong_file_leaves_everything_as_it_was(manager: Manager):
    def broken() -> RigConfig:
        raise ConfigError("rig.toml: bus[0].baud: no drive has this rate (given: 1)")

    async with service_of(manager, broken) as (service, daemon, _client):
        await daemon.wait_up()
        before = daemon.config
        manager.heard()

        service.reload()

        told = next(message for message in await manager.listen(1) if message.startswith("READY=1"))
        assert "configuration not reloaded: rig.toml: bus[0].baud" in told
        assert daemon.config is before


async def test_a_bug_beside_the_daemon_ends_it_in_order(manager: Manager):
    """Cancelled, it would leave what moves to itself."""

    def fails() -> RigConfig:
        raise LookupError("a bug")

    left: list[Daemon] = []

    async def run() -> None:
        async with service_of(manager, fails) as (service, daemon, client):
            left.append(daemon)
            await daemon.wait_up()
            await asyncio.sleep(1.0)  # the drives are read
            await client.command("x", Power(on=True))
            await client.command("x", MoveVelocity(velocity=5.0))
            service.reload()
            await asyncio.sleep(5.0)

    with pytest.raises(ExceptionGroup) as ended:
        await run()

    assert ended.group_contains(LookupError, match="a bug")
    assert left[0].moving_at_end
    assert left[0].moving_at_end["x"] is Moving.NO


async def test_rates_that_the_line_cannot_carry_are_not_taken(manager: Manager):
    config = load_config(SIMULATED)
    changed = with_axis(config, "x", rates=config.bus[0].axis[0].rates.model_copy(update={"position": 2000.0}))
    async with service_of(manager, lambda: changed) as (service, daemon, _client):
        await daemon.wait_up()
        manager.heard()

        service.reload()

        told = next(message for message in await manager.listen(1) if message.startswith("READY=1"))
        assert "configuration not reloaded: bus line0" in told
        assert daemon.config == config
