"""The shared vocabulary: frozen pydantic models, the single source of `schemas/`."""
