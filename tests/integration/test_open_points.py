"""What documents leave open about PIC-SERVO SC, CMC and PIC-I/O, played in every variant: the daemon does the same."""

import asyncio
from enum import StrEnum

import pytest

from ldcnd.config.rig import RigConfig
from ldcnd.contract.commands import Home, MoveAbsolute, MoveRelative, MoveVelocity, Power, Probe, Reset
from ldcnd.contract.rig_commands import SetIo
from ldcnd.contract.samples import AxisState, LinkState, TelemetryItem
from ldcnd.sim.ldcn.chain import MODELS, ChainSpec, ModuleSpec, build_chain
from ldcnd.sim.ldcn.quirks import ModuleSettings
from ldcnd.sim.plant import MotorPlant
from tests.support.dialect_rig import COUNTS_PER_MM, GAINS
from tests.support.rig import running_rig

PLANT = MotorPlant(
    reverse_limit_counts=-20_000, forward_limit_counts=6_000, index_at_counts=1000, index_width_counts=40
)
BAUDS = {"pic-servo-sc": 230_400, "pic-servo-cmc": 115_200}


def variants(model: str) -> dict[str, list[object]]:
    """Return what each switch of this model may also be."""
    default = MODELS[model][1]
    others: dict[str, list[object]] = {}
    for name, value in default:
        if isinstance(value, bool):
            others[name] = [not value]
        elif isinstance(value, StrEnum):
            others[name] = [each for each in type(value) if each is not value]
    others["undefined_status_bits"], others["undefined_level_bits"] = [0xFD], [0xF]
    if model == "pic-servo-sc":
        del others["always_obeys_global_reset"]  # its data sheet says so
    return others


def chosen(model: str, turn: int) -> dict[str, object]:
    """Return every switch at another variant, the first for turn 1, the second for turn 2."""
    return {name: values[(turn - 1) % len(values)] for name, values in variants(model).items()}


def config(model: str, drives: int) -> RigConfig:
    axis = {
        "model": model,
        "unit": "mm",
        "counts_per_unit": COUNTS_PER_MM,
        "velocity": 20,
        "acceleration": 200,
        "reference": "at_reset",
        "gains": GAINS,
        "rates": {"position": 10, "velocity": 5, "state": 5},
    }
    bus = {
        "name": "line",
        "port": "sim:line",
        "baud": BAUDS[model],
        "axis": [axis | {"name": f"a{place}", "address": place} for place in range(1, drives + 1)],
    }
    sim = [{"model": model}] * drives
    if model == "pic-servo-cmc":
        bus["module"] = [
            {"name": f"io{place}", "address": drives + place, "model": "pic-io", "outputs": [4]} for place in (1, 2)
        ]
        sim += [{"model": "pic-io"}] * 2
    return RigConfig.model_validate({"rig": "open", "sim": [{"name": "line", "module": sim}], "bus": [bus]})


async def works(rig, name: str) -> dict[str, object]:
    """Take one axis through all that a client does with it; return what it answered, and where the shaft stood."""
    client = rig.client
    seen: dict[str, object] = {}

    async def done(title, command):
        reply = await client.command(name, command)
        state = await client.wait_for_end(name, reply.command_id)
        seen[title] = (state.state, state.last_error, state.referenced)

    await rig.until(name, lambda state: state.state is AxisState.DISABLED)
    await client.command(name, Power(on=True))
    await done("move", MoveAbsolute(position=-3.0))
    await done("relative", MoveRelative(distance=1.0, velocity=3.0))
    await done("home", Home(method="index", velocity=1.0, position=0.0))
    await client.command(name, MoveVelocity(velocity=4.0))
    await asyncio.sleep(0.3)
    seen["stop"] = (await client.stop(name)).confirmed == (name,)
    await rig.until(name, lambda state: state.state is AxisState.STANDSTILL)
    await client.command(name, Reset())
    await client.command(name, Power(on=True))
    await done("probe", Probe(sources=("forward_limit",), position=9.0, velocity=4.0))
    latch = await client.last(name, TelemetryItem.LATCH)
    seen["latched"] = pytest.approx(latch.value, abs=2 * latch.error)
    await done("back", MoveAbsolute(position=2.0))
    return seen


async def compared(model: str, settings: list[ModuleSettings]) -> None:
    """Do the same work on drives with these settings, the first of which is the default, and compare."""
    drives = [ModuleSpec(model, PLANT, each) for each in settings]
    if model == "pic-servo-cmc":
        io = MODELS["pic-io"][1]
        drives += [ModuleSpec("pic-io", settings=each) for each in (io, io.model_copy(update=chosen("pic-io", 1)))]
    chain = build_chain(ChainSpec(tuple(drives)))
    names = [f"a{place}" for place in range(1, len(settings) + 1)]
    async with running_rig(config(model, len(settings)), {"line": chain}) as rig:
        async with asyncio.TaskGroup() as group:
            working = [group.create_task(works(rig, name), name=name) for name in names]
        default, *others = [task.result() for task in working]
        for each, setting in zip(others, settings[1:], strict=True):
            assert each == default, setting
        now_s = asyncio.get_running_loop().time()
        for module in chain.modules[: len(settings)]:
            module.catch_up(now_s)
            assert module.shaft.position_counts == pytest.approx(chain.modules[0].shaft.position_counts, abs=30)

        # one that was without power is brought back, whatever it leaves open
        for module in chain.modules[1 : len(settings)]:
            module.power(on=False, at_s=now_s)
        await asyncio.sleep(1.0)
        for module in chain.modules[1 : len(settings)]:
            module.power(on=True, at_s=asyncio.get_running_loop().time())
        for name in names[1:]:
            state = await rig.until(
                name, lambda state: state.link is LinkState.UP and state.state is AxisState.ERROR_STOP
            )
            assert not state.referenced
            assert not state.enabled
        if model == "pic-servo-cmc":
            replies = [await rig.client.ask(SetIo(module=f"io{place}", low=[4], pwm1=0.5)) for place in (1, 2)]
            assert replies[0].levels == replies[1].levels
            assert [module.pwm for module in chain.modules[-2:]] == [(128, 0)] * 2


@pytest.mark.parametrize("model", BAUDS)
@pytest.mark.sweep(2)
async def test_the_daemon_depends_on_no_open_point(model):
    default = MODELS[model][1]

    await compared(model, [default, *(default.model_copy(update=chosen(model, turn)) for turn in (1, 2))])


@pytest.mark.soak
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("model", BAUDS)
async def test_the_daemon_depends_on_no_open_point_alone(model):
    default = MODELS[model][1]

    for name, values in variants(model).items():
        await compared(model, [default, *(default.model_copy(update={name: value}) for value in values)])
