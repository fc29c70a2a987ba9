"""The check list of a release refuses what must not be handed out."""

import hashlib
import subprocess
from pathlib import Path

import pytest

from tests.support.pages import ROOT
from tools.release import PACKAGES, STEPS, NotReady, committed, complete, main, named

ARTEFACTS = (
    "ldcnd-1.2.0-py3-none-any.whl",
    "ldcnd-1.2.0.tar.gz",
    *(f"{name}_1.2.0_amd64{suffix}" for name in PACKAGES for suffix in (".deb", ".cdx.json")),
)


@pytest.fixture
def tree(tmp_path: Path) -> Path:
    """Return a committed tree that is ready."""
    root = tmp_path / "tree"
    (root / "tests/kept/1.2.0").mkdir(parents=True)
    (root / "tests/kept/1.2.0/contract.txt").write_text("+ network api: 1\n")
    (root / "tests/kept/1.2.0/run.mcap").touch()
    (root / "pyproject.toml").write_text('[project]\nversion = "1.2.0"\n')
    (root / "CHANGELOG.md").write_text("# Changelog\n\n## 1.2.0 (2027-01-31)\n\n## 1.1.0 (2026-12-01)\n")
    git(root, "init", "--quiet")
    git(root, "add", "--all")
    git(root, "commit", "--quiet", "-m", "all")
    return root


def git(root: Path, *words: str) -> None:
    who = ("-c", "user.name=x", "-c", "user.email=x@localhost", "-c", "commit.gpgsign=false")
    subprocess.run(["git", *who, *words], cwd=root, check=True)  # noqa: S603, S607


@pytest.fixture
def dist(tmp_path: Path) -> Path:
    """Return artefacts with their checksums."""
    place = tmp_path / "dist"
    place.mkdir()
    for name in ARTEFACTS:
        (place / name).write_text(name)
    sums = [f"{hashlib.sha256(name.encode()).hexdigest()}  {name}" for name in ARTEFACTS]
    (place / "SHA256SUMS").write_text("\n".join(sums) + "\n")
    return place


def test_a_tree_and_artefacts_that_are_ready_pass(tree: Path, dist: Path):
    committed(tree)
    named(tree)
    complete(dist, tree)


@pytest.mark.parametrize("heading", ["1.2.0 (not yet released)", "1.3.0 (2027-02-01)", "1.2.0"])
def test_a_version_without_its_date_is_refused(tree: Path, heading: str):
    (tree / "CHANGELOG.md").write_text(f"# Changelog\n\n## {heading}\n")

    with pytest.raises(NotReady, match=r"has to begin with `## 1\.2\.0 "):
        named(tree)


def test_a_version_that_is_tagged_is_not_made_again(tree: Path):
    git(tree, "tag", "v1.2.0")

    with pytest.raises(NotReady, match="tagged already"):
        named(tree)


@pytest.mark.parametrize(("name", "remedy"), [("contract.txt", "make fix"), ("run.mcap", "kept_files")])
def test_a_version_without_what_later_ones_are_held_to_is_refused(tree: Path, name: str, remedy: str):
    (tree / "tests/kept/1.2.0" / name).unlink()

    with pytest.raises(NotReady, match=remedy):
        named(tree)


def test_what_is_not_committed_is_named(tree: Path):
    (tree / "more.py").touch()

    with pytest.raises(NotReady, match=r"more\.py"):
        committed(tree)


@pytest.mark.parametrize("name", ARTEFACTS)
def test_an_artefact_that_is_missing_or_changed_is_named(tree: Path, dist: Path, name: str):
    (dist / name).write_text("changed")
    with pytest.raises(NotReady, match="SHA256SUMS") as changed:
        complete(dist, tree)
    assert name in str(changed.value)

    (dist / name).unlink()
    with pytest.raises(NotReady, match="not one each"):
        complete(dist, tree)


def test_a_stranger_among_the_artefacts_is_named(tree: Path, dist: Path):
    (dist / "left-over.whl").touch()

    with pytest.raises(NotReady, match="left-over"):
        complete(dist, tree)


def test_the_list_ends_at_what_fails_and_goes_on_there(monkeypatch: pytest.MonkeyPatch, capsys):
    taken: list[str] = []

    def step(name: str) -> None:
        taken.append(name)
        if name == "dist-check" and taken.count(name) == 1:
            raise NotReady("no")

    for each in STEPS:
        monkeypatch.setitem(STEPS, each, lambda each=each: step(each))
    monkeypatch.setattr("sys.argv", ["release"])
    with pytest.raises(SystemExit, match="dist-check: no"):
        main()
    monkeypatch.setattr("sys.argv", ["release", "--from", "dist-check"])
    main()

    assert taken == [
        *list(STEPS)[: list(STEPS).index("dist-check") + 1],
        *list(STEPS)[list(STEPS).index("dist-check") :],
    ]
    assert "git tag" in capsys.readouterr().out


def test_each_step_that_is_a_target_is_one_of_the_makefile():
    makefile = (ROOT / "Makefile").read_text()

    for name in ("test", "test-system", "test-edges", "test-pythons", "soak", "newcomer", "dist-check"):
        assert f"\n{name}:" in makefile
