"""The drive families: one folder each, and `family.py`, the contract that the rest of the house knows them by.

For whoever adds a drive family. Start at `family.py`; `known.py` lists the families.
"""
