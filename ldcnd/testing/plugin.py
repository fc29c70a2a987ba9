"""The plugin for pytest: the fixtures `ldcnd_rig` and `ldcnd_served_rig`, and what a failed test with it shows.

Loaded by pytest wherever ldcnd is installed, so it imports nothing of ldcnd before a test asks for a rig.
"""

import asyncio
import inspect
import tempfile
import warnings
from collections.abc import AsyncIterator, Callable, Generator, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from ldcnd.testing.rig import SimulatedRig
    from ldcnd.testing.served import ServedRig

RIG = "ldcnd_rig"
EXAMPLE = "simulated.toml"
WITHIN_S = 3600.0
"""A test that takes longer on the rig's clock fails, unless its marker says otherwise; that is under a minute here."""


def pytest_configure(config: pytest.Config) -> None:
    """Name the marker."""
    config.addinivalue_line(
        "markers",
        f"ldcnd_rig(file, seed=None, within_s={WITHIN_S:g}): the configuration on which `ldcnd_rig` rehearses, the"
        " seed of what is drawn, and how long the test may take on the rig's clock",
    )


@pytest.hookimpl(wrapper=True)  # before that of pytest-asyncio, whichever of the two was loaded first
def pytest_generate_tests(metafunc: pytest.Metafunc) -> Generator[None]:
    """Let pytest-asyncio find the clock of tests on a rig, also where it runs only what is marked."""
    _mark(metafunc.definition)
    return (yield)


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
        def unavailable() -> None:
            from ldcnd.parts import missing  # noqa: PLC0415 - see above

            pytest.fail(f"the fixture ldcnd_rig needs pytest-asyncio 1.4 or later: {missing('pytest_asyncio').remedy}")

        return unavailable
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

    file, seed, within_s = _asked_for(request)
    async with simulated_rig(file, seed=seed, within_s=within_s) as rig:
        request.node.stash[RIG_OF_TEST] = rig
        yield rig
        for fault in rig.faults.to_come:
            warnings.warn(f"{fault} never began: the test did not meet what it is about", stacklevel=2)


def _asked_for(request: pytest.FixtureRequest) -> tuple[Path, int | None, float]:
    """Return the configuration, the seed and the longest time of the marker of a test."""
    from ldcnd.config.rig import example  # noqa: PLC0415 - see above

    def asked(
        file: Path | str | None = None, *, seed: int | None = None, within_s: float = WITHIN_S
    ) -> tuple[Path, int | None, float]:
        return request.path.parent / file if file else example(EXAMPLE), seed, within_s

    marker = request.node.get_closest_marker(RIG)
    try:
        return asked(*marker.args, **marker.kwargs) if marker else asked()
    except TypeError as error:
        pytest.fail(f"@pytest.mark.ldcnd_rig: {str(error).partition(') ')[2]}", pytrace=False)


ldcnd_rig = _async_fixture(_rig)


@pytest.fixture
def ldcnd_served_rig(request: pytest.FixtureRequest) -> "Iterator[ServedRig]":
    """Serve the rig of the marker `ldcnd_rig` in real time, for programs in other processes."""
    from ldcnd.testing.served import served_rig  # noqa: PLC0415 - see above

    file, seed, _ = _asked_for(request)
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
        rig.settle()
        lines = [str(rig.timeline), rig.packets()]
        name = "".join(letter if letter.isalnum() else "_" for letter in item.name)
        picture = rig.timeline.draw(Path(tempfile.mkdtemp(prefix="ldcnd-")) / f"{name}.png")
        if picture:
            lines.append(f"positions over time: {picture}")
        report.sections.append(("what happened on the rig", "\n".join(lines)))
    return report
