"""Everything that crosses the network: frozen pydantic models, the single source of `schemas/`.

Serves the daemon, its clients and the schemas. Start with `commands` and `samples`; `catalogue` lists all of them.
"""
