"""What the commissioning page does to tune a SmartStep: gains that are tried between two of its records.

For `ldcnd.console.commissioning.tuning`, which loads it by the name that the family object gives. Start with `tuning`.
"""
