"""The `ldcnd` command: one module per noun."""
