"""Commands for drives of this family alone, loaded by the name that the family object gives.

For `ldcnd tune`, which asks the family of an axis. Start with `tune`.
"""
