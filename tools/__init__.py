"""Tools of the developers, which are not shipped: `python -m tools` writes all that is generated and committed."""
