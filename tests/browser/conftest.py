"""What the browser tests share: everything runs once, for all of them that one worker has."""

from collections.abc import AsyncIterator
from typing import TYPE_CHECKING

import pytest
import pytest_asyncio

if TYPE_CHECKING:
    from tests.browser.house import House
    from tests.browser.windows import Window


@pytest_asyncio.fixture(scope="package", loop_scope="package")
async def house(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator["House"]:
    """Daemons, console and browser."""
    from tests.browser.house import open_house  # noqa: PLC0415 - it needs playwright

    async with open_house(tmp_path_factory.mktemp("house")) as running:
        yield running


@pytest_asyncio.fixture(scope="module", loop_scope="package", params=["chromium", "firefox"])
async def window(
    request: pytest.FixtureRequest, house: "House", tmp_path_factory: pytest.TempPathFactory
) -> AsyncIterator["Window"]:
    """A page of one engine."""
    from tests.browser.windows import open_chromium, open_gecko  # noqa: PLC0415 - it needs playwright

    opened = {"chromium": open_chromium, "firefox": open_gecko}[request.param]
    async with opened(house, tmp_path_factory.mktemp("profile")) as page:
        yield page
