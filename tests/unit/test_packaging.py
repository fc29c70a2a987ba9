"""What is handed out: the same bytes from the same source, with everything in it, and a list of what it needs."""

import os
import re
import shutil
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
from hatchling.builders.sdist import SdistBuilder
from hatchling.builders.wheel import WheelBuilder

from ldcnd.contract.fault_pages import codes
from tests.support.pages import ROOT
from tools.schemas import all_schemas

pytestmark = pytest.mark.timeout(300)  # the first test of a worker builds wheel and sdist

NOT_SOURCE = shutil.ignore_patterns(".git", ".venv*", "build", "dist", "state", "__pycache__", ".*_cache", ".hyp*")
EPOCH = "1700000000"
RUNTIME_EXTRAS = {"bench", "console", "fast", "foxglove", "journal", "lab", "ops", "plot", "tui"}
PINS = set(re.findall(r"(?m)^([\w.-]+)==(\S+)", (ROOT / "constraints.txt").read_text()))


def built(source: Path, out: Path) -> dict[str, Path]:
    """Build a wheel and an sdist without fetching anything."""
    wheel, *_ = WheelBuilder(str(source)).build(directory=str(out), versions=["standard"])
    sdist, *_ = SdistBuilder(str(source)).build(directory=str(out), versions=["standard"])
    return {"wheel": Path(wheel), "sdist": Path(sdist)}


@pytest.fixture(scope="module")
def twice(tmp_path_factory: pytest.TempPathFactory) -> list[dict[str, Path]]:
    """Build from two copies of the source, in other places, of other ages and with other rights."""
    results = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SOURCE_DATE_EPOCH", EPOCH)
        for age_s, mode in ((0, 0o644), (86400, 0o664)):
            place = tmp_path_factory.mktemp("build")
            source = place / f"source{age_s}"
            shutil.copytree(ROOT, source, ignore=NOT_SOURCE)
            for path in source.rglob("*"):
                if path.is_file():
                    path.chmod(mode | (path.stat().st_mode & 0o111))
                    os.utime(path, (1.6e9 + age_s, 1.6e9 + age_s))
            results.append(built(source, place / "dist"))
    return results


def test_the_same_interpreters_are_declared_promised_and_tested() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    declared = [name.rpartition(" ")[2] for name in project["classifiers"] if name.startswith("Programming")]
    (tested,) = re.findall(r"(?m)^PYTHONS \?= (.*)$", (ROOT / "Makefile").read_text())
    (promised,) = re.findall(r"CPython (\S+) to (\S+) on Linux", (ROOT / "README.md").read_text())

    assert project["requires-python"] == f">={declared[0]}"
    assert tested.split() == [f"python{version}" for version in declared]
    assert promised == (declared[0], declared[-1])


@pytest.mark.system
@pytest.mark.parametrize("kind", ["wheel", "sdist"])
def test_the_same_source_gives_the_same_bytes(twice: list[dict[str, Path]], kind: str) -> None:
    one, other = (build[kind] for build in twice)

    assert one.name == other.name
    assert one.read_bytes() == other.read_bytes()


@pytest.mark.long
def test_the_wheel_has_the_pages_and_no_tests(twice: list[dict[str, Path]]) -> None:
    with zipfile.ZipFile(twice[0]["wheel"]) as wheel:
        names = set(wheel.namelist())
        metadata = wheel.read(next(name for name in names if name.endswith("METADATA"))).decode()
        shipped = {Path(name).stem: wheel.read(name).decode() for name in names if name.startswith("ldcnd/schemas/")}

    assert {f"ldcnd/contract/fault_pages/{code}.md" for code in codes()} <= names
    assert shipped == all_schemas()
    assert "ldcnd/py.typed" in names
    assert {name.partition("/")[0].partition("-")[0] for name in names} == {"ldcnd"}
    assert set(re.findall(r"(?m)^Provides-Extra: (\S+)", metadata)) >= RUNTIME_EXTRAS


@pytest.mark.long
def test_the_sdist_has_what_building_testing_and_reading_takes(twice: list[dict[str, Path]]) -> None:
    with tarfile.open(twice[0]["sdist"]) as sdist:
        names = {name.partition("/")[2] for name in sdist.getnames()}

    assert {
        "pyproject.toml",
        "constraints.txt",
        "Makefile",
        "CONTRIBUTING.md",
        "deploy/build_deb.sh",
        "docs/conf.py",
        "docs/tutorials/first-rig.md",
        "examples/move_and_watch.py",
        "schemas/fault_sample.json",
        "tests/unit/test_packaging.py",
    } <= names
    assert not [name for name in names if name.startswith(("docs/faults/", "build/", ".venv/"))]


def test_the_wheel_names_the_licence_of_each_script_that_it_holds(twice):
    with zipfile.ZipFile(twice[0]["wheel"]) as wheel:
        [place] = [name for name in wheel.namelist() if name.endswith(".dist-info/METADATA")]
        metadata = wheel.read(place).decode()

    vendored = {str(path.relative_to(ROOT)) for path in ROOT.glob("ldcnd/console/static/vendor/*/LICENSE*")}
    assert "License-Expression: Apache-2.0 AND MIT AND ISC\n" in metadata
    assert {"LICENSE", *vendored} == set(re.findall(r"(?m)^License-File: (.+)$", metadata))
