"""The JSON Schemas of all that crosses the network and of the configuration file."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType

from ldcnd.config.rig import RigConfig
from ldcnd.contract.catalogue import PUBLIC_MODELS
from ldcnd.contract.frozen import Frozen, schema_name, schema_text


@cache
def all_schemas() -> Mapping[str, str]:
    """Return the schema text of every public model by name, as `schemas` has it; made once."""
    models: tuple[type[Frozen], ...] = (*PUBLIC_MODELS, RigConfig)
    return MappingProxyType({schema_name(model): schema_text(model) for model in models})


def write_schemas(folder: Path) -> int:
    """Write all schemas into a folder, removing those of models that are gone; return how many there are."""
    folder.mkdir(exist_ok=True)
    schemas = all_schemas()
    for name, text in schemas.items():
        (folder / f"{name}.json").write_text(text, encoding="utf-8")
    for path in folder.glob("*.json"):
        if path.stem not in schemas:
            path.unlink()
    return len(schemas)


def shipped_schemas() -> Mapping[str, bytes]:
    """Return the same from their files, as `meta/schema/<name>` serves them.

    A daemon generates none: that takes half as long as all the rest of its start-up, and `python -m tools check` holds
    the files to the models.
    """
    package = Path(__file__).parents[1]
    installed = package / "schemas"  # a wheel has a copy here; in a checkout they are beside the package
    folder = installed if installed.is_dir() else package.parent / "schemas"
    return {path.stem: path.read_bytes() for path in sorted(folder.glob("*.json"))}
