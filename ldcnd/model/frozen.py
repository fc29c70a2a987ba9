"""The base of everything that crosses the network or comes from a file: frozen, strict about names, finite."""

from pydantic import BaseModel, ConfigDict


class Frozen(BaseModel):
    """An immutable model that refuses unknown fields, NaN and infinity.

    What validates and encodes a model is built when it is needed first: a program seldom needs more than a few of them.
    """

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True, defer_build=True
    )


def build_models(model: type[Frozen] = Frozen) -> None:
    """Build all models that are known by now, so that whoever is to answer in time does not wait for it then."""
    for known in model.__subclasses__():
        known.model_rebuild()
        build_models(known)
