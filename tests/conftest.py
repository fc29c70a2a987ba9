"""Which clock a test runs on, and what no test may leave behind."""

import asyncio
import gc
import random
import re
import signal
import sys
from collections import Counter, defaultdict
from collections.abc import AsyncIterator, Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import structlog
from hypothesis import settings
from pytest_asyncio import is_async_test
from structlog._config import BoundLoggerLazyProxy
from xdist.workermanage import WorkerController

from ldcnd.testing.jumping_loop import JumpingLoop

# one run is like the other, so more examples find nothing new; `make soak` looks at what was never tried, and prints
# how to repeat what it finds
settings.register_profile("same", derandomize=True, deadline=None, print_blob=True, max_examples=50)
settings.register_profile("new", deadline=None, print_blob=True)
settings.load_profile("same")


def pytest_configure(config: pytest.Config) -> None:
    """Let programs that tests start take an interrupt, also where the tests themselves run in the background.

    All processes of a run draw the same share of the soak.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    if hasattr(config, "workerinput"):
        config.option.draw = config.workerinput["draw"]
    elif config.option.draw is None:
        config.option.draw = random.randrange(1_000_000)


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: WorkerController) -> None:
    """Have a further process draw what this one draws."""
    node.workerinput["draw"] = node.config.option.draw


def pytest_report_header(config: pytest.Config) -> list[str]:
    """Say how to draw the same share of the soak once more."""
    share, draw = config.option.share, config.option.draw
    return [f"soak: --share {share:g} --draw {draw}"] if share < 1 else []


def kept_here() -> tuple[tuple[str, int], ...]:
    """Return the files of the folder `state` below the working directory, and when each was written."""
    return tuple(sorted((str(file), file.stat().st_mtime_ns) for file in Path("state").rglob("*")))


def pytest_sessionstart(session: pytest.Session) -> None:
    """Note what lies in the folder that the examples name: what one test kept there would be read by another."""
    session.stash[KEPT] = kept_here()


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail when a test has run an example with its own folder for what outlives the daemon."""
    if not hasattr(session.config, "workerinput") and kept_here() != session.stash[KEPT]:
        sys.stderr.write("a test has kept something in the folder `state` of the working directory\n")
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


KEPT = pytest.StashKey[tuple[tuple[str, int], ...]]()


def pytest_addoption(parser: pytest.Parser) -> None:
    """Let soak tests begin at another seed: `pytest -m soak tests/property --from 5000 --count 1000 -n 2`."""
    parser.addoption("--from", type=int, default=1000, help="first seed of the soak tests that take `seeds`")
    parser.addoption("--count", type=int, default=1000, help="how many seeds")
    parser.addoption(
        "--share", type=float, default=1.0, help="take so much of the rows of each soak test, at least one"
    )
    parser.addoption("--draw", type=int, help="which rows; others in each run if missing")


SEEDS_OF_A_TEST = 250


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Cut the seeds of soak tests into pieces that processes share."""
    if "seeds" in metafunc.fixturenames and metafunc.definition.get_closest_marker("soak"):
        first = metafunc.config.getoption("--from")
        end = first + metafunc.config.getoption("--count")
        pieces = [range(at, min(at + SEEDS_OF_A_TEST, end)) for at in range(first, end, SEEDS_OF_A_TEST)]
        metafunc.parametrize("seeds", pieces, ids=str)


OF_A_MODULE = re.compile(r"^pytestmark = (?:\[\s*)?pytest\.mark\.(\w+)", re.MULTILINE)
OF_A_FOLDER = {"browser": "system", "edges": "edges", "guest": "guest"}


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out modules and folders whose first mark is not wanted: to import them takes every worker seconds."""
    mark = OF_A_FOLDER.get(collection_path.name)
    if collection_path.suffix == ".py" and (found := OF_A_MODULE.search(collection_path.read_text())):
        mark = found[1]
    return True if mark and re.search(rf"\bnot {mark}\b", config.option.markexpr) else None


def pytest_runtest_setup() -> None:
    """Log as if nothing had run before: a program that a test has run may have configured a level.

    Loggers that were used meanwhile keep it by a method of their own.
    """
    if not structlog.is_configured():
        return
    structlog.reset_defaults()
    for module in [module for name, module in sys.modules.items() if name.startswith("ldcnd.")]:
        logger = getattr(module, "log", None)
        if isinstance(logger, BoundLoggerLazyProxy):
            vars(logger).pop("bind", None)


def pytest_asyncio_loop_factories(
    config: pytest.Config, item: pytest.Item
) -> Mapping[str, Callable[[], asyncio.AbstractEventLoop]]:
    """Jump through time, unless the test says that it needs the wall clock."""
    if item.get_closest_marker("real_time"):
        return {"real": asyncio.new_event_loop}
    return {"jumping": JumpingLoop}


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark as long what is left out of a sweep, before tests are chosen by their marks.

    Have every test that runs on a loop looked at; a loop for each of the thousands of others costs ten seconds.
    """
    take_share_of_soak(config, items)
    rows = Counter[tuple[Path, str]]()
    for item in items:
        if (sweep := item.get_closest_marker("sweep")) and not item.get_closest_marker("soak"):
            function = item.path, item.nodeid.partition("[")[0]
            if rows[function] % sweep.args[0]:
                item.add_marker(pytest.mark.long)
            rows[function] += 1
        if is_async_test(item) and nothing_is_left.__name__ not in item.fixturenames:
            item.fixturenames.insert(0, nothing_is_left.__name__)


def take_share_of_soak(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave some rows of each soak test, drawn by `--draw`."""
    rows = defaultdict[str, list[pytest.Item]](list)
    for item in items:
        if item.get_closest_marker("soak"):
            rows[item.nodeid.partition("[")[0]].append(item)
    left = set[pytest.Item]()
    for test, its in rows.items():
        taken = max(1, round(config.option.share * len(its)))
        left.update(set(its).difference(random.Random(f"{config.option.draw} {test}").sample(its, taken)))
    if left:
        config.hook.pytest_deselected(items=list(left))
        items[:] = [item for item in items if item not in left]


def pytest_collection_finish() -> None:
    """Leave what was collected out of each garbage collection: thousands of tests are looked through otherwise."""
    gc.collect()
    gc.freeze()


@pytest.fixture
async def nothing_is_left() -> AsyncIterator[None]:
    """Fail the test that leaves a task running, or in which a callback of the loop has raised: that is only logged."""
    raised = list[str]()

    def note(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        loop.default_exception_handler(context)
        # of a task or future that nobody has waited for it is told when it is collected, perhaps in another test
        if "future" not in context and (error := context.get("exception")):
            raised.append(f"{context['message']}: {error!r}")

    asyncio.get_running_loop().set_exception_handler(note)
    yield
    here = asyncio.current_task()
    left = [task for task in asyncio.all_tasks() if task is not here and not task.done()]
    assert not left, f"tasks left running: {[task.get_name() for task in left]}"
    assert not raised, f"raised in the loop: {raised}"
