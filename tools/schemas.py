"""The JSON Schemas of all that crosses the network and of the configuration file, as `make fix` writes them."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType

from ldcnd.config.rig import RigConfig
from ldcnd.contract.catalogue import PUBLIC_MODELS
from ldcnd.contract.frozen import Frozen, schema_name, schema_text


@cache
def all_schemas() -> Mapping[str, str]:
    """Return the schema text of every public model by name; made once."""
    models: tuple[type[Frozen], ...] = (*PUBLIC_MODELS, RigConfig)
    return MappingProxyType({schema_name(model): schema_text(model) for model in models})


def write_schemas(folder: Path) -> None:
    """Write all schemas into a folder, removing those of models that are gone."""
    schemas = all_schemas()
    for name, text in schemas.items():
        (folder / f"{name}.json").write_text(text, encoding="utf-8")
    for path in folder.glob("*.json"):
        if path.stem not in schemas:
            path.unlink()
