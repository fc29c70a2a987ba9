"""Schedules: what clients do, and what befalls them, the line, its modules and the daemons, each at its instant.

A schedule is drawn from a seed as a list, so that it can be repeated, and tried again with acts left out. `Play` lives
through one on a rig that is up: every act is a task of its own, clients renew their leases meanwhile, and a
`ShaftJudge` sees everything that is sent and everything that drives do.
"""

import asyncio
import contextlib
import random
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field, replace
from typing import NoReturn

from ldcnd.client.rig_client import RigClient
from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import (
    AxisCommand,
    BufferMode,
    CommandReply,
    Direction,
    Halt,
    Jog,
    MoveAbsolute,
    MoveRelative,
    MoveVelocity,
    Power,
    QuickStop,
    Reset,
    SetGains,
    SetPosition,
)
from ldcnd.contract.errors import LdcndError, OutcomeUnknown, TransportLost
from ldcnd.contract.keys import Keys
from ldcnd.contract.leases import Acquire, Release, Renew
from ldcnd.contract.rig_commands import AxisMove, AxisPath, LinePath, MoveTogether, WalkPath
from ldcnd.contract.samples import LinkState
from ldcnd.daemon.assembly import build_daemon
from ldcnd.daemon.daemon import Daemon
from ldcnd.drives.ldcn.registers import RESET_BAUD
from ldcnd.sim.faults import FaultInjector, FaultKind, FaultPlan, LineFault
from ldcnd.sim.line import SimulatedLine, open_simulated_line
from ldcnd.testing.jumping_loop import JumpingLoop
from ldcnd.testing.memory_session import MemoryBroker
from tests.support.shaft_judge import Held, ShaftJudge, now_ns

RIG, LINE = "sim", "a"
LEASE_S = 0.3
REST_S = 1.0
"""From the end of a lease, or the return of the line, until the axis stands: stops are sent again on a bad line, then
it decelerates."""
BACK_WITHIN_S = 20.0
PLACES_PROVEN_S = 90.0
"""Until modules whose servo cycles end at the same instant have been told apart."""
ALONE = "switch one of them off and on again, alone"
"""What the daemon tells a person to do with modules that it cannot tell apart."""
KINDS = [kind for kind in FaultKind if kind not in (FaultKind.UNPLUGGED, FaultKind.ECHO, FaultKind.REPLY_FALSIFIED)]
FAR, NEAR, CORNERS = 36.0, 4.0, 3
"""How far absolute moves go, some of them beyond the limits; how far relative ones and paths; corners of a path."""
SHORT_S = 0.03
HOLDER = "holder"
"""Whichever client has control; it takes control first where it has lost it."""


@dataclass(frozen=True, slots=True)
class Act:
    """One thing that happens.

    Attributes:
        at_s: when, from the beginning of the schedule.
        what: the name of a method of `Play`, without its underscore.
        who: which client, `HOLDER` for the one that has control, or how a daemon starts.
        axis: which; empty for all.
        command: what is sent, or sent again.
        for_s: how long something lasts.
        places: of the modules concerned, from 0.
    """

    at_s: float
    what: str
    who: str = ""
    axis: str = ""
    command: AxisCommand[CommandReply] | MoveTogether | WalkPath | None = None
    for_s: float = 0.0
    places: tuple[int, ...] = ()


OF_CLIENTS = {"send": 60, "again": 6, "renew": 8, "recover": 14, "stop": 3, "acquire": 4, "release": 1, "die": 1}
"""How often clients do what."""
BEFALLS = ("cut", "freeze", "power_loss", "terminate", "kill", "rival")
"""What befalls a rig: of these, each schedule has some."""


class Drawing:
    """Draws one schedule."""

    def __init__(self, seed: int, settings: RigConfig, begins_ns: int) -> None:
        self.begins_ns = begins_ns
        self.dice = random.Random(seed)
        (bus,) = settings.bus
        self.axes = {axis.name: axis for axis in bus.axis}
        self.groups = [group.axes for group in bus.group]
        self.walks = all(axis.model == "pic-servo-sc" for axis in bus.axis)
        self.sent: list[AxisCommand[CommandReply] | MoveTogether | WalkPath] = []
        self.jogs: list[tuple[str, str]] = []
        self._numbers = iter(range(10**6))

    def schedule(self) -> tuple[Act, ...]:
        """Return the acts in their order."""
        dice, at_s = self.dice, 0.0
        acts = [Act(0.0, "acquire", "ann")]
        weights = dict(OF_CLIENTS)
        for what in dice.sample(BEFALLS, dice.choice((0, 1, 1, 2, 3))):
            weights[what] = dice.choice((3, 6, 12))
            if what == "rival":
                weights["rival_leaves"] = weights[what]
        for _ in range(dice.randint(8, 50)):
            at_s += dice.choice((0.0, dice.uniform(0, 0.01), dice.uniform(0, 0.08), dice.uniform(0, 0.08), 0.2))
            (what,) = dice.choices(list(weights), list(weights.values()))
            acts.append(self._act(at_s, what, dice.choice((HOLDER, HOLDER, HOLDER, HOLDER, "ann", "bob"))))
        return tuple(acts)

    def _act(self, at_s: float, what: str, who: str) -> Act:
        dice = self.dice
        match what:
            case "send":
                return Act(at_s, what, who, *self._command(self.begins_ns + round(at_s * 1e9)))
            case "again" if self.sent:
                command = dice.choice(self.sent[-8:])
                return Act(at_s, what, who, command=command)
            case "renew" if self.jogs:
                axis, command_id = self.jogs[-1]
                command = Jog(velocity=dice.choice((5.0, -5.0, 20.0)), renews=command_id, hold_s=0.2)
                return Act(at_s, what, who, axis, command)
            case "stop" | "recover":
                return Act(at_s, what, who, dice.choice(("", *self.axes)))
            case "acquire":
                return Act(at_s, what, dice.choice(("ann", "bob")), for_s=dice.choice((0.0, 0.0, 1.0)))
            case "cut":
                return Act(at_s, what, for_s=dice.choice((0.01, 0.05, 0.3, 1.0)))
            case "freeze":
                return Act(at_s, what, for_s=dice.choice((0.01, 0.1, 0.5, 3.0)))
            case "power_loss":
                places = tuple(at for at in range(len(self.axes)) if dice.random() < 0.6) or (0,)
                return Act(at_s, what, for_s=dice.choice((0.002, 0.03, 0.3, 1.5)), places=places)
            case "terminate" | "kill" | "rival":
                start = dice.choice(("adopt", "adopt", "reset"))
                return Act(at_s, what, start, for_s=dice.choice((0.0, 0.05, 2.0)))
        return Act(at_s, "acquire" if what in ("again", "renew") else what, dice.choice(("ann", "bob")))

    def _command(self, at_ns: int) -> tuple[str, AxisCommand[CommandReply] | MoveTogether | WalkPath]:
        """Return the axis of a command, or none for that of a group, and the command."""
        dice = self.dice
        command: AxisCommand[CommandReply] | MoveTogether | WalkPath
        if self.groups and dice.random() < 0.35:
            names = dice.choice(self.groups)
            if self.walks and dice.random() < 0.6:
                command = WalkPath(moves=tuple(self._share(name) for name in names))
            else:
                moves = tuple(
                    AxisMove(axis=name, position=self._place(name, NEAR), command_id=self._id()) for name in names
                )
                command = MoveTogether(moves=moves, path=dice.choice(list(LinePath)))
            self.sent.append(command)
            return "", command
        name = dice.choice(list(self.axes))
        command = self._axis_command(name, at_ns)
        self.sent.append(command)
        return name, command

    def _id(self) -> str:
        return f"c{next(self._numbers)}"

    def _place(self, name: str, most: float) -> float:
        modulo = self.axes[name].modulo
        return self.dice.uniform(-most, most) if modulo is None else self.dice.uniform(0, modulo)

    def _direction(self, name: str) -> Direction | None:
        return self.dice.choice((None, *Direction)) if self.axes[name].modulo is not None else None

    def _share(self, name: str) -> AxisPath:
        turning = self.axes[name].modulo is not None
        *via, end = (
            self.dice.uniform(-NEAR, NEAR) % 360 if turning else self._place(name, NEAR) for _ in range(CORNERS)
        )
        return AxisPath(axis=name, via=tuple(via), position=end, command_id=self._id())

    def _axis_command(self, name: str, at_ns: int) -> AxisCommand[CommandReply]:
        dice, command_id = self.dice, self._id()
        distance, speed = dice.uniform(-NEAR, NEAR), dice.choice((5.0, 20.0, 30.0, 31.0))
        most = {"velocity": dice.choice((None, speed)), "acceleration": dice.choice((None, 200.0, 1000.0))}
        move = {
            "command_id": command_id,
            "buffer_mode": dice.choice(list(BufferMode)),
            "not_after": dice.choice((None, None, at_ns + round(SHORT_S * 1e9))),
        }
        kind = dice.choices(range(12), (18, 10, 14, 12, 8, 4, 4, 3, 1, 2, 3, 1))[0]
        match kind:
            case 0 | 1:
                place, way = self._place(name, FAR if kind else NEAR), self._direction(name)
                return MoveAbsolute(position=place, direction=way, **move, **most)
            case 2:
                return MoveRelative(distance=distance, **move, **most)
            case 3:
                velocity = dice.choice((-1, 1)) * speed
                return MoveVelocity(velocity=velocity, **move)
            case 4:
                self.jogs.append((name, command_id))
                return Jog(velocity=dice.choice((-20.0, 5.0, 20.0)), hold_s=dice.choice((0.2, 0.4)), **move)
            case 5:
                return Power(on=True, command_id=command_id)
            case 6:
                return Reset(command_id=command_id)
            case 7:
                return Halt(command_id=command_id)
            case 8:
                return QuickStop(command_id=command_id)
            case 9:
                return Power(on=False, command_id=command_id)
            case 10:
                return SetPosition(position=self._place(name, NEAR), command_id=command_id)
        return SetGains(kp=dice.choice((349, 350)), lent=True, command_id=command_id)


class Rig:
    """The daemons of one rig: one has the port, others wait for it.

    Attributes:
        running: daemons and their tasks, by instance.
        owner: which has the port, or had it last.
    """

    def __init__(self, settings: Callable[[str], RigConfig], judge: ShaftJudge, broker: MemoryBroker) -> None:
        self.broker = broker
        self.running: dict[str, tuple[Daemon, asyncio.Task[None]]] = {}
        self.owner: Daemon | None = None
        self._settings = settings
        self._judge = judge
        self._line: SimulatedLine | None = None

    async def start(self, start: str) -> Daemon:
        """Start one more daemon."""
        instance = f"d{len(self._judge.born)}"
        made: asyncio.Future[Daemon] = asyncio.get_running_loop().create_future()
        task = asyncio.create_task(self._serve(instance, start, made), name=instance)
        self._judge.born[instance] = asyncio.get_running_loop().time()
        daemon = await made
        self.running[instance] = daemon, task
        return daemon

    async def _serve(self, instance: str, start: str, made: "asyncio.Future[Daemon]") -> None:
        async with self.broker.session() as session:

            async def open_port() -> SimulatedLine:
                if self._line is not None and self._line._gone is None:
                    raise TransportLost("the port is in use")
                line = await open_simulated_line(self._judge.chain, RESET_BAUD)
                self._line, self.owner = line, daemon
                self._judge.daemon = daemon
                return line

            daemon = build_daemon(self._settings(start), session, now_ns, instance, openers={LINE: open_port})
            made.set_result(daemon)
            await daemon.run()

    async def end(self, daemon: Daemon) -> None:
        """Have a daemon end in order, as SIGTERM does."""
        instance = daemon._run.instance
        self._judge.ended.setdefault(instance, asyncio.get_running_loop().time())
        daemon.end()
        if instance in self.running:
            _, task = self.running[instance]
            await asyncio.wait([task])
            self.running.pop(instance, None)
            if not task.cancelled() and (error := task.exception()):
                self._judge.wrong.append(f"{instance} ended with {error!r}")

    @contextlib.asynccontextmanager
    async def watched(self) -> AsyncIterator[None]:
        """Keep the book of daemons, and look at the shafts, for the time of the context."""
        judge, keys = self._judge, Keys(RIG)

        def on_token(key: str, alive: bool) -> None:  # noqa: FBT001 - the session's signature
            address = keys.parse_alive(key)
            if address.axis is None:
                (judge.daemons.add if alive else judge.daemons.discard)(address.instance)

        judge.daemons.clear()
        async with self.broker.session() as session:
            await session.watch_tokens(keys.all_alive, on_token)
            watching = asyncio.create_task(judge.watch(), name="judge")
            try:
                yield
            finally:
                watching.cancel()


@dataclass
class Play:
    """One life through a schedule.

    Attributes:
        acts: what happens.
        judge: who sees it.
        rig: the daemons.
        is_good: the line loses nothing.
        rest_s: from what brings an axis to rest until it stands.
        kill: goes on behind an act that kills the daemons, without ever coming back.
    """

    acts: tuple[Act, ...]
    judge: ShaftJudge
    rig: Rig
    is_good: bool
    rest_s: float
    kill: "Callable[[Play, int, float], NoReturn]"
    clients: dict[str, RigClient] = field(default_factory=dict)
    leases: dict[str, str] = field(default_factory=dict)
    disturbed_s: list[float] = field(default_factory=list)

    async def run(self, from_act: int, zero_s: float) -> None:
        """Live through the acts from one on."""
        loop = asyncio.get_running_loop()
        async with contextlib.AsyncExitStack() as stack:
            for name in ("ann", "bob"):
                session = await stack.enter_async_context(self.rig.broker.session())
                self.clients[name] = RigClient(session, RIG)
            await stack.enter_async_context(self.rig.watched())
            tasks = [asyncio.create_task(self._keep(name), name=f"{name} renews") for name in self.clients]
            try:
                for at, act in enumerate(self.acts[from_act:], from_act):
                    await asyncio.sleep(max(0.0, zero_s + act.at_s - loop.time()))
                    if act.what == "kill":
                        self.kill(self, at, zero_s)
                    tasks.append(asyncio.create_task(self._do(act), name=f"{at} {act.what}"))
                    if act.what == "freeze":
                        await asyncio.sleep(0)
                await asyncio.sleep(LEASE_S)
                self.leases.clear()
                await asyncio.wait(
                    [task for task in tasks[2:] if not task.done()] or [asyncio.create_task(asyncio.sleep(0))]
                )
            finally:
                for task in tasks:
                    task.cancel()
            for task in tasks:
                if task.done() and not task.cancelled() and (error := task.exception()):
                    raise error
            self.judge.wrong += await self.verdict()

    async def _do(self, act: Act) -> None:
        with contextlib.suppress(LdcndError):
            if act.who == HOLDER:
                act = replace(act, who=next(iter(self.leases), "ann"))
                if act.who not in self.leases and act.what in ("send", "recover"):
                    await self._acquire(act)
            await getattr(self, f"_{act.what}")(act)

    # -- clients -----------------------------------------------------------------------------------------------------

    async def _keep(self, name: str) -> None:
        """Renew the lease of a client until it has none."""
        while True:
            if (token := self.leases.get(name)) and (held := self.judge.leases.get(token)):
                before_s = held.until_s
                try:
                    await self.clients[name].ask(Renew(lease=token), timeout_s=0.2)
                    held.until_s = max(before_s, self.judge.now_s + LEASE_S)
                except OutcomeUnknown:
                    held.until_s = max(before_s, self.judge.now_s + LEASE_S)
                except LdcndError:
                    self.leases.pop(name, None)
            await asyncio.sleep(LEASE_S / 4)

    async def _acquire(self, act: Act) -> None:
        own = self.leases.get(act.who)
        request = Acquire(client=act.who, lease_s=LEASE_S, force=bool(act.for_s), replaces=(own,) if own else ())
        reply = await self.clients[act.who].ask(request, timeout_s=0.2)
        now_s, leases = self.judge.now_s, self.judge.leases
        held = Held(act.who, now_s + LEASE_S)
        before = leases.get(own) if own else None
        for token, other in leases.items():
            if other is before:
                leases[token] = held if other.until_s > now_s else other  # what it has replaced holds with it
            else:
                other.until_s = min(other.until_s, now_s)
        leases[reply.lease] = held
        self.leases[act.who] = reply.lease

    async def _release(self, act: Act) -> None:
        if token := self.leases.pop(act.who, None):
            await self.clients[act.who].ask(Release(lease=token), timeout_s=0.2)
            self.judge.leases[token].until_s = self.judge.now_s

    async def _die(self, act: Act) -> None:
        self.leases.pop(act.who, None)

    async def _send(self, act: Act) -> None:
        lease = self.leases.get(act.who)
        match act.command:
            case MoveTogether(moves=moves) | WalkPath(moves=moves) as command:
                shares = tuple(share.model_copy(update={"lease": lease}) for share in moves)
                await self._ask(act.who, command.model_copy(update={"moves": shares}))
            case AxisCommand() as command:
                await self._command(act.who, act.axis, command.model_copy(update={"lease": lease}))

    async def _recover(self, act: Act) -> None:
        """Clear what forbids motion, and close the loops."""
        for name in (act.axis,) if act.axis else tuple(self.judge.settings):
            lease, number = self.leases.get(act.who), len(self.judge.asked)
            for command in (
                Reset(command_id=f"r{number}", lease=lease),
                Power(on=True, command_id=f"p{number}", lease=lease),
            ):
                await self._command(act.who, name, command)

    async def _again(self, act: Act) -> None:
        """Send what was sent already as it was sent; whoever does."""
        match act.command:
            case MoveTogether(moves=moves) | WalkPath(moves=moves) as command:
                known = [self.judge.asked[share.command_id] for share in moves if share.command_id in self.judge.asked]
                if len(known) == len(moves):
                    await self._ask(
                        act.who, command.model_copy(update={"moves": tuple(each.command for each in known)})
                    )
            case AxisCommand(command_id=command_id) if command_id in self.judge.asked:
                known_one = self.judge.asked[command_id]
                await self._command(act.who, known_one.axis, known_one.command)

    async def _renew(self, act: Act) -> None:
        if isinstance(act.command, Jog):
            lease = self.leases.get(act.who)
            command = act.command.model_copy(update={"lease": lease})
            if (begun := self.judge.asked.get(act.command.renews or "")) and isinstance(begun.command, Jog):
                held = self.judge.leases.get(begun.command.lease or "")  # one that a client replaces holds with the new
                if held is not None and held.client == act.who:
                    self.judge.renewed[act.command.renews or ""] = self.judge.now_s
                await self.clients[act.who].command(act.axis, command, timeout_s=0.2)

    async def _ask(self, who: str, command: MoveTogether | WalkPath) -> None:
        asked = [self.judge.sent(share.axis, share) for share in command.moves]
        try:
            await self.clients[who].ask(command, timeout_s=1.0)
        except OutcomeUnknown:
            pass
        except LdcndError:
            for each in asked:
                self.judge.answered(each, accepted=False)

    async def _command(self, who: str, axis: str, command: AxisCommand[CommandReply]) -> None:
        judge, client = self.judge, self.clients[who]
        if isinstance(command, QuickStop):
            judge.stopped(axis)
        asked, since_s = judge.sent(axis, command), judge.now_s
        ends = isinstance(command, (Halt, QuickStop)) or (isinstance(command, Power) and not command.on)
        checks = asyncio.create_task(self._rests(axis, since_s, command)) if ends else None
        accepted: bool | None = None
        try:
            await client.command(axis, command, timeout_s=1.0)
            accepted = True
        except OutcomeUnknown:
            pass
        except LdcndError as error:
            accepted = False
            if ends and self._is_whole():
                judge.wrong.append(f"{since_s:.4f}: {command!r} of {axis} was refused: {error}")
            elif ends and checks:
                checks.cancel()
        finally:
            judge.answered(asked, accepted=accepted)
        if checks:
            await asyncio.wait([checks])

    async def _stop(self, act: Act) -> None:
        names, since_s = (act.axis,) if act.axis else tuple(self.judge.settings), self.judge.now_s
        for name in names:
            self.judge.stopped(name)
        checks = [asyncio.create_task(self._rests(name, since_s, None)) for name in names]
        try:
            reply = await self.clients[act.who].stop(act.axis or None, timeout_s=1.0)
            self.judge.kept(reply.kept, since_s)
        except LdcndError as error:
            if self._is_whole() and not isinstance(error, OutcomeUnknown):
                self.judge.wrong.append(f"{since_s:.4f}: the stop of {act.axis or 'all'} was refused: {error}")
        await asyncio.wait(checks)

    def _is_whole(self) -> bool:
        """Tell whether every module can hear, and somebody has the line up."""
        owner, chain, now_s = self.rig.owner, self.judge.chain, self.judge.now_s
        return (
            owner is not None
            and owner.rig.buses[0].report is not None
            and owner._run.instance not in self.judge.ended
            and chain.plugged(now_s)
            and all(
                module.address == at and abs(module.baud / chain.baud - 1) < 0.03
                for at, module in enumerate(self.judge.modules, 1)
            )
        )

    async def _rests(self, axis: str, since_s: float, command: AxisCommand[CommandReply] | None) -> None:
        """Hold what has to bring an axis to rest against what its drive does."""
        owner, whole = self.rig.owner, self._is_whole()
        await asyncio.sleep(self.rest_s)
        judge, until_s = self.judge, since_s + self.rest_s
        undisturbed = not any(since_s - 1e-3 <= at_s <= until_s + 1e-3 for at_s in self.disturbed_s)
        if not (self.is_good and whole and undisturbed and self._is_whole() and self.rig.owner is owner):
            return
        what = "stop" if command is None else command.verb
        if not any(since_s - 1e-6 <= at_s <= until_s for at_s in judge.heard[axis]):
            judge.wrong.append(f"{since_s:.4f}: {what} did not reach {axis}")
        later = [asked for asked in judge.asked.values() if asked.axis == axis and max(asked.sent_s) >= since_s]
        moved_since = judge.begun[axis].at_s >= since_s
        if isinstance(command, Power):
            closed = judge.drive(axis).loop.servo_on
            if closed and not any(isinstance(each.command, Power) and each.command.on for each in later):
                judge.wrong.append(f"{since_s:.4f}: the loop of {axis} is closed after power off")
        elif not judge.is_at_rest(axis) and not moved_since:
            judge.wrong.append(f"{since_s:.4f}: {axis} moves {self.rest_s:g} s after {what}")

    # -- what befalls them -------------------------------------------------------------------------------------------

    def _disturb(self, for_s: float = 0.0) -> None:
        now_s = asyncio.get_running_loop().time()
        self.disturbed_s += [now_s, now_s + for_s]

    async def _cut(self, act: Act) -> None:
        self._disturb(act.for_s)
        self.judge.out_of_reach.append((self.judge.now_s, self.judge.now_s + act.for_s))
        self.judge.chain.unplug(self.judge.now_s, act.for_s)

    async def _freeze(self, act: Act) -> None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, JumpingLoop)
        self._disturb(act.for_s)
        self.judge.frozen.append((loop.time(), loop.time() + act.for_s))
        self.judge.out_of_reach.append((loop.time(), loop.time() + act.for_s))
        loop.hold_up(act.for_s)

    async def _power_loss(self, act: Act) -> None:
        self._disturb(act.for_s)
        modules = [self.judge.modules[at] for at in act.places]
        for module in modules:
            module.power(on=False, at_s=self.judge.now_s)
        await asyncio.sleep(act.for_s)
        for module in modules:
            module.power(on=True, at_s=self.judge.now_s)

    async def _terminate(self, act: Act) -> None:
        if self.rig.owner is None or self.rig.owner._run.instance in self.judge.ended:
            return
        self._disturb()
        await self.rig.end(self.rig.owner)
        await asyncio.sleep(act.for_s)
        self._disturb()
        await self.rig.start(act.who)

    async def _rival(self, act: Act) -> None:
        if len(self.rig.running) < 3:
            await self.rig.start(act.who)

    async def _rival_leaves(self, act: Act) -> None:
        if len(self.rig.running) > 1:
            self._disturb()
            daemon, _ = list(self.rig.running.values())[-1]
            await self.rig.end(daemon)

    # -- the end -----------------------------------------------------------------------------------------------------

    async def verdict(self) -> list[str]:
        """Look at a rig whose clients are all dead, with the whole of it plugged in; return what is wrong."""
        judge, chain = self.judge, self.judge.chain
        chain.replug()
        for module in judge.modules:
            if not module._powered:  # its daemon was killed meanwhile
                module.power(on=True, at_s=judge.now_s)
        chain.injector = FaultInjector(FaultPlan())
        alive = [daemon for daemon, _ in self.rig.running.values() if daemon._run.instance not in judge.ended]
        for daemon in alive[1:]:
            await self.rig.end(daemon)
        daemon = alive[0] if alive else await self.rig.start("adopt")
        for instance, (_, task) in self.rig.running.items():
            if task.done() and not task.cancelled() and (error := task.exception()):
                return [f"{instance} ended with {error!r}"]
        why = await self._comes_back(daemon)
        for _ in judge.modules:
            if ALONE in why:
                await self._switch_one_off_and_on()
                why = await self._comes_back(daemon)
        if why:
            return [why]
        async with self.rig.broker.session() as session:  # who takes control answers for what is left running
            with contextlib.suppress(LdcndError):
                request = Acquire(client="last", lease_s=LEASE_S, force=True)
                await RigClient(session, RIG).ask(request, timeout_s=1.0)
        await asyncio.sleep(LEASE_S + REST_S)
        if why := await self._comes_back(daemon):  # what had just lost its power was not known to be away
            return [why]
        judge.came_up(daemon)
        places = {name: zeros[0] for name, zeros in judge.zeros.items() if len(zeros) == 1}
        turning = [name for name, axis in judge.settings.items() if axis.modulo is not None]
        await judge.look(daemon, {name: zero for name, zero in places.items() if name not in turning})
        return [
            f"{name} stands and carries out {axis.tracker.status.command.verb}"
            for name, axis in daemon.rig.axes.items()
            if axis.tracker.status.command is not None
        ]

    async def _switch_one_off_and_on(self) -> None:
        """Do what the daemon asks for: switch one module that has no address off and on again, alone."""
        module = next(module for at, module in enumerate(self.judge.modules, 1) if module.address != at)
        module.power(on=False, at_s=self.judge.now_s)
        await asyncio.sleep(1.0)
        module.power(on=True, at_s=self.judge.now_s)

    async def _comes_back(self, daemon: Daemon) -> str:
        """Wait until every drive answers; return why it does not."""
        line = daemon.rig.buses[0]
        for within_s in (BACK_WITHIN_S, PLACES_PROVEN_S):
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(within_s):
                    await all_up(daemon)
                    return ""
            if "not proven" not in line.problem:
                break
        links = {name: axis.tracker.status.link.value for name, axis in daemon.rig.axes.items()}
        return f"{links}, {within_s:g} s after everything was plugged in: {line.problem or 'no problem'}"


async def all_up(daemon: Daemon) -> None:
    """Return as soon as every drive answers."""
    await daemon.wait_up()
    while any(axis.tracker.status.link is not LinkState.UP for axis in daemon.rig.axes.values()):
        await asyncio.sleep(0.05)


def faults_of(seed: int, now_s: float) -> tuple[LineFault, ...]:
    """Return what is wrong with the line in a schedule."""
    share = random.Random(seed).choice((0.0, 0.0, 0.02, 0.1))
    return tuple(LineFault(kind, share / len(KINDS), now_s, longest_s=0.02) for kind in KINDS) if share else ()
