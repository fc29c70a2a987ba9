"""What the browser tests share: everything runs once, for all of them that one worker has."""

from collections.abc import AsyncIterator
from typing import TYPE_CHECKING

import pytest
import pytest_asyncio

if TYPE_CHECKING:
    from tests.browser.house import House


@pytest_asyncio.fixture(scope="package", loop_scope="package")
async def house(tmp_path_factory: pytest.TempPathFactory) -> AsyncIterator["House"]:
    """Daemons, console and browser."""
    from tests.browser.house import open_house  # noqa: PLC0415 - it needs playwright

    async with open_house(tmp_path_factory.mktemp("house")) as running:
        yield running
