"""The plugin for pytest: the fixtures `ldcnd_rig` and `ldcnd_served_rig`, and what a failed test with it shows.

Loaded by pytest wherever ldcnd is installed, so it imports nothing of ldcnd before a test asks for a rig.
"""

import asyncio
import inspect
import tempfile
from collections.abc import AsyncIterator, Callable, Generator, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from ldcnd.testing.rig import SimulatedRig
    from ldcnd.testing.served import ServedRig

RIG = "ldcnd_rig"
EXAMPLE = "simulated.toml"


def pytest_configure(config: pytest.Config) -> None:
    """Name the marker."""
    config.addinivalue_line("markers", "ldcnd_rig(file, seed=None): the configuration on which `ldcnd_rig` rehearses")


@pytest.hookimpl(tryfirst=True)
def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Let pytest-asyncio find the clock of tests on a rig, also where it runs only what is marked."""
    _mark(metafunc.definition)


@pytest.hookimpl(wrapper=True, trylast=True)
def pytest_pycollect_makeitem() -> Generator[None, Any, Any]:
    """Let tests on a rig be run by pytest-asyncio, also where it runs only what is marked."""
    made = yield
    for item in made if isinstance(made, list) else [made]:
        if isinstance(item, pytest.Function):
            _mark(item)
    return made


def _mark(item: pytest.Function) -> None:
    if RIG in item.fixturenames and inspect.iscoroutinefunction(item.obj):
        item.add_marker(pytest.mark.asyncio)


@pytest.hookimpl(optionalhook=True)
def pytest_asyncio_loop_factories(item: pytest.Item) -> Mapping[str, Callable[[], asyncio.AbstractEventLoop]]:
    """Let tests on a rig run on its clock, and all others as they did."""
    if RIG not in getattr(item, "fixturenames", ()):
        return {"asyncio": asyncio.new_event_loop}
    from ldcnd.testing.jumping_loop import JumpingLoop  # noqa: PLC0415 - see above

    return {"jumping": JumpingLoop}


def _async_fixture(function: Callable[..., AsyncIterator[Any]]) -> Any:  # noqa: ANN401 - a fixture is of no public type
    try:
        import pytest_asyncio  # noqa: PLC0415 - an extra
    except ModuleNotFoundError:

        @pytest.fixture(name=RIG)
        def missing() -> None:
            pytest.fail("the fixture ldcnd_rig needs pytest-asyncio 1.4 or later: pip install 'ldcnd[testing]'")

        return missing
    return pytest_asyncio.fixture(name=RIG)(function)


async def _rig(request: pytest.FixtureRequest) -> "AsyncIterator[SimulatedRig]":
    """Rehearse on the rig that `@pytest.mark.ldcnd_rig("rig.toml")` names, beside the test, or on one of four axes."""
    if not inspect.iscoroutinefunction(request.function):
        pytest.fail(
            "ldcnd_rig needs a test that is `async def`; a program that waits without asyncio runs in one by"
            " `await ldcnd_rig.run_blocking(program)`",
            pytrace=False,
        )
    from ldcnd.testing.rig import simulated_rig  # noqa: PLC0415 - see above

    file, seed = _asked_for(request)
    async with simulated_rig(file, seed=seed) as rig:
        request.node.stash[RIG_OF_TEST] = rig
        yield rig


def _asked_for(request: pytest.FixtureRequest) -> tuple[Path, int | None]:
    """Return the configuration and the seed of the marker of a test."""
    from ldcnd.config.rig import example  # noqa: PLC0415 - see above

    marker = request.node.get_closest_marker(RIG)
    file = request.path.parent / marker.args[0] if marker and marker.args else example(EXAMPLE)
    return file, marker.kwargs.get("seed") if marker else None


ldcnd_rig = _async_fixture(_rig)


@pytest.fixture
def ldcnd_served_rig(request: pytest.FixtureRequest) -> "Iterator[ServedRig]":
    """Serve the rig of the marker `ldcnd_rig` in real time, for programs in other processes."""
    from ldcnd.testing.served import served_rig  # noqa: PLC0415 - see above

    file, seed = _asked_for(request)
    with served_rig(file, seed=seed) as rig:
        request.node.stash[RIG_OF_TEST] = rig.ask(lambda served: served)
        yield rig


RIG_OF_TEST = pytest.StashKey["SimulatedRig"]()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Show what happened on the rig of a test that failed."""
    report = yield
    rig = item.stash.get(RIG_OF_TEST, None)
    if rig is not None and report.when == "call" and report.failed:
        lines = [str(rig.timeline), rig.packets()]
        name = "".join(letter if letter.isalnum() else "_" for letter in item.name)
        picture = rig.timeline.draw(Path(tempfile.mkdtemp(prefix="ldcnd-")) / f"{name}.png")
        if picture:
            lines.append(f"positions over time: {picture}")
        report.sections.append(("what happened on the rig", "\n".join(lines)))
    return report
