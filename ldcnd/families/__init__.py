"""The drive families: one folder each, and `family.py`, the contract between them and the other packages.

For developers who add a drive family. Start with `family.py`; `known.py` lists the families.
"""
