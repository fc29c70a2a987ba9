"""What is marked alike in tests of what everything of one worker shares."""

import pytest

IN_THE_HOUSE = (
    pytest.mark.real_time,
    pytest.mark.asyncio(loop_scope="package"),
    pytest.mark.timeout(240),
)
