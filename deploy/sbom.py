"""Print what an installed ldcnd is made of, as a software bill of materials (CycloneDX 1.6, JSON).

Run it with the interpreter of the environment that it is to describe: `python sbom.py [EXTRA ...]`; without names, all
extras that a user can want count. Same environment and SOURCE_DATE_EPOCH: same bytes.
"""

import json
import os
import re
import sys
import uuid
from collections import deque
from datetime import UTC, datetime
from importlib.metadata import Distribution, PackageNotFoundError, distribution

ROOT = "ldcnd"
FOR_DEVELOPERS = frozenset({"docs", "edges", "test"})
REQUIREMENT = re.compile(r"(?P<name>[\w.-]+)\s*(?:\[(?P<extras>[^]]*)\])?")
EXTRA_MARKER = re.compile(r"extra\s*==\s*['\"]([\w.-]+)['\"]")
CLASSIFIED = "License :: OSI Approved :: "

Node = dict[str, object]


def installed(name: str) -> Distribution | None:
    """Return a package of this environment."""
    try:
        return distribution(name)
    except PackageNotFoundError:
        return None


def normal(name: str) -> str:
    """Return the one spelling of a package's name."""
    return re.sub(r"[-_.]+", "-", name).lower()


def requirements(package: Distribution, extras: frozenset[str]) -> dict[str, frozenset[str]]:
    """Return which installed packages a package needs with these extras of it, and with which extras of theirs.

    What another platform or another Python would need is not installed here, so it is left out.
    """
    needed: dict[str, frozenset[str]] = {}
    for line in package.requires or ():
        wanted_for = EXTRA_MARKER.search(line)
        if wanted_for and wanted_for[1] not in extras:
            continue
        match = REQUIREMENT.match(line)
        if match and installed(match["name"]):
            names = frozenset(part.strip() for part in (match["extras"] or "").split(",") if part.strip())
            name = normal(match["name"])
            needed[name] = needed.get(name, frozenset()) | names
    return needed


def licences(package: Distribution) -> list[Node]:
    """Return what a package says about its licence."""
    for expression in package.metadata.get_all("License-Expression") or ():
        return [{"expression": expression}]
    classified = [line for line in package.metadata.get_all("Classifier") or () if line.startswith(CLASSIFIED)]
    names = [line.removeprefix(CLASSIFIED) for line in sorted(classified)]
    names = names or [text.strip().partition("\n")[0] for text in package.metadata.get_all("License") or ()]
    return [{"license": {"name": name}} for name in names if name]


def component(package: Distribution, kind: str) -> Node:
    """Return one package as a component."""
    name, version = normal(package.metadata["Name"]), package.version
    reference = f"pkg:pypi/{name}@{version}"
    described: Node = {"type": kind, "bom-ref": reference, "name": name, "version": version, "purl": reference}
    if found := licences(package):
        described["licenses"] = found
    return described


def bill(extras: frozenset[str]) -> Node:
    """Return the bill of materials of ldcnd with these extras."""
    root = distribution(ROOT)
    packages = {ROOT: root}
    wanted = {ROOT: extras}
    edges: dict[str, set[str]] = {}
    waiting = deque([ROOT])
    while waiting:
        name = waiting.popleft()
        for needed, its_extras in requirements(packages[name], wanted[name]).items():
            edges.setdefault(name, set()).add(needed)
            before = wanted.get(needed)
            if before is None or not its_extras <= before:
                packages[needed] = distribution(needed)
                wanted[needed] = (before or frozenset()) | its_extras
                waiting.append(needed)
    components = {name: component(package, "library") for name, package in sorted(packages.items())}
    refs = {name: str(described["bom-ref"]) for name, described in components.items()}
    del components[ROOT]
    made_at = datetime.fromtimestamp(int(os.environ.get("SOURCE_DATE_EPOCH", "0")), UTC)
    return {
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "serialNumber": uuid.uuid5(uuid.NAMESPACE_OID, " ".join(sorted(refs.values()))).urn,
        "version": 1,
        "metadata": {"timestamp": made_at.isoformat(), "component": component(root, "application")},
        "components": list(components.values()),
        "dependencies": [
            {"ref": ref, "dependsOn": sorted(refs[needed] for needed in edges.get(name, ()))}
            for name, ref in refs.items()
        ],
    }


def main() -> None:
    """Print the bill."""
    known = frozenset(distribution(ROOT).metadata.get_all("Provides-Extra") or ())
    extras = frozenset(sys.argv[1:]) or known - FOR_DEVELOPERS
    if unknown := sorted(extras - known):
        sys.exit(f"{ROOT} has no extra {', '.join(unknown)}; it has {', '.join(sorted(known))}")
    json.dump(bill(extras), sys.stdout, indent=1)
    print()


if __name__ == "__main__":
    main()
