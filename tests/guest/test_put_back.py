"""The faults that are put back to try the tests on drivers still fit the code, without a guest."""

import pytest

from tests.guest.put_back import FAULTS, ROOT, put_back


@pytest.mark.parametrize("name", FAULTS)
def test_fault_can_be_put_back(name, tmp_path):
    place = tmp_path / FAULTS[name].path
    place.parent.mkdir(parents=True)
    place.write_text((ROOT / FAULTS[name].path).read_text(encoding="utf-8"), encoding="utf-8")

    put_back(tmp_path, name)

    compile(place.read_text(encoding="utf-8"), str(place), "exec")
