"""Writes what is generated and committed: schemas, the client's methods, reference pages, the contract.

`python -m tools client` writes the methods of the client alone, also when those that there are cannot be loaded;
`python -m tools check` fails when the schemas are not what the models say; `python -m tools man FOLDER` writes
man pages; `python -m tools sbom FILE` writes what this interpreter's environment is made of, vendored scripts included.
"""

import argparse
import ast
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import ldcnd
from ldcnd.contract.errors import ERRORS
from tools.channels import keys_table
from tools.schemas import all_schemas, write_schemas
from tools.verb_methods import verb_methods, with_blocking_methods

ROOT = Path(__file__).parents[1]
REFERENCE = ROOT / "docs" / "reference"
SCHEMAS = ROOT / "schemas"
KEPT = ROOT / "tests" / "kept"
STUB = ROOT / "ldcnd" / "__init__.pyi"
VENDORED = ROOT / "ldcnd" / "console" / "static" / "vendor"


def main() -> None:
    """Do what the first argument says; without one, write everything but the client's methods."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", choices=("all", "client", "check", "man", "sbom"), default="all")
    parser.add_argument("place", nargs="?", type=Path, help="folder of the man pages, file of the bill of materials")
    options = parser.parse_args()
    match options.what:
        case "client":
            write_client()
        case "check":
            check()
        case "man":
            write_man_pages(options.place)
        case "sbom":
            write_bill(options.place)
        case _:
            write_all()


def write_client() -> None:
    """Write the methods of the Python client; `make fix` formats them."""
    folder = ROOT / "ldcnd" / "client"
    (folder / "verbs.py").write_text(verb_methods(), encoding="utf-8")
    blocking = folder / "blocking.py"
    blocking.write_text(with_blocking_methods(blocking.read_text(encoding="utf-8")), encoding="utf-8")


def package_stub() -> str:
    """Return `ldcnd/__init__.pyi`, which tells type checkers and editors what `ldcnd` names; as ruff formats it."""
    named = {name: getattr(ldcnd, name) for name in dir(ldcnd)}
    found = sorted((value.__module__, value.__name__, name) for name, value in named.items())
    lines = ["# made by `make fix` from what `__init__.py` names; not edited"]
    lines += [f"from {module} import {own}{f' as {name}' if own != name else ''}" for module, own, name in found]
    names = [f'    "{name}",' for name in sorted(named)]
    return "\n".join([*lines, "", "__all__ = [", *names, "]"]) + "\n"


def write_all() -> None:
    """Write the schemas, what the package names, and the reference pages."""
    STUB.write_text(package_stub(), encoding="utf-8")
    # not above: the client's methods can be written also when those that there are cannot be loaded
    from tools.client_reference import client_reference  # noqa: PLC0415
    from tools.config_reference import config_reference  # noqa: PLC0415
    from tools.manual import as_markdown  # noqa: PLC0415
    from tools.public_contract import keep  # noqa: PLC0415

    write_schemas(SCHEMAS)
    pages = {"configuration": config_reference(), "cli": as_markdown(), "python": client_reference()}
    for name, text in pages.items():
        (REFERENCE / f"{name}.md").write_text(text, encoding="utf-8")
    tables = {"keys": keys_table(), "errors": errors_table(), "motor-record": rules_table()}
    for name, table in tables.items():
        renew_table(REFERENCE / f"{name}.md", table)
    keep(KEPT, (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"))


def check() -> None:
    """End the program with an error when the schemas differ from what the models say."""
    schemas = all_schemas()
    on_disk = {path.stem: path.read_text(encoding="utf-8") for path in SCHEMAS.glob("*.json")}
    differing = sorted(name for name in schemas.keys() | on_disk.keys() if schemas.get(name) != on_disk.get(name))
    if differing:
        sys.exit(f"{SCHEMAS} differs from the models in: {', '.join(differing)}; run `make fix`")
    namespace: dict[str, object] = {}
    exec(STUB.read_text(encoding="utf-8"), namespace)  # noqa: S102 - our own code
    if namespace["__all__"] != sorted(dir(ldcnd)):
        sys.exit(f"{STUB} is not what `ldcnd` names; run `make fix`")


def write_man_pages(folder: Path) -> None:
    """Write the man pages of all commands into a folder."""
    from tools.manual import man_pages  # noqa: PLC0415 - likewise

    folder.mkdir(parents=True, exist_ok=True)
    for name, text in man_pages().items():
        (folder / name).write_text(text, encoding="utf-8")


def write_bill(file: Path) -> None:
    """Write a bill of materials of the environment, in CycloneDX, by cyclonedx-py (or the program $CYCLONEDX)."""
    program = os.environ.get("CYCLONEDX") or str(Path(sys.executable).with_name("cyclonedx-py"))
    words = [program, "environment", sys.executable, "--of", "JSON", "--output-reproducible"]
    bill = json.loads(subprocess.run(words, check=True, capture_output=True).stdout)  # noqa: S603 - our own
    for row in re.findall(r"(?m)^\| `(?!folder).*$", (VENDORED / "README.md").read_text(encoding="utf-8")):
        folder, name, release, _, licence, *_ = (cell.strip(" `") for cell in row.strip("|").split("|"))
        bill["components"].append(
            {
                "bom-ref": f"vendored/{folder}",
                "type": "library",
                "name": name,
                "version": release,
                "purl": f"pkg:npm/{name.replace('@', '%40')}@{release}",
                "licenses": [{"license": {"id": each}} for each in re.findall(r"MIT|ISC|Apache-2\.0", licence)],
            }
        )
    file.write_text(json.dumps(bill, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def renew_table(page: Path, table: str) -> None:
    """Replace the list at the end of a page."""
    before, found, _ = page.read_text(encoding="utf-8").partition(table.partition("\n")[0])
    if not found:
        sys.exit(f"{page}: has no such table")
    page.write_text(before + table, encoding="utf-8")


def errors_table() -> str:
    """Return all codes as a Markdown list."""
    lines = ["All codes; the same request may be sent again later for those that are marked:", ""]
    for code, error in ERRORS.items():
        meaning = " ".join((error.__doc__ or "").split())
        lines.append(f"* `{code}`{' (retryable)' if error.retryable else ''}: {meaning}")
    return "\n".join(lines) + "\n"


def rules_table() -> str:
    """Return the rules of the motor record, made of the tests that hold them, as a Markdown table."""
    rows = []
    for path in (ROOT / "tests" / "integration").glob("*.py"):
        text = path.read_text(encoding="utf-8")
        tests = [each for each in ast.parse(text).body if isinstance(each, ast.AsyncFunctionDef)]
        for node in tests if "mark.record(" in text else ():
            for mark in node.decorator_list:
                match mark:
                    case ast.Call(
                        func=ast.Attribute(attr="record"), args=[ast.Constant(str(field)), ast.Constant(str(rule))]
                    ):
                        rows.append(f"| {field} | {rule} (`{node.name}`) |\n")
    return "".join(["| field | rule (test) |\n|---|---|\n", *sorted(rows)])


if __name__ == "__main__":
    main()
