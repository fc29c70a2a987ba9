"""What the commissioning page does to tune an axis of an LDCN or NMC drive; needs the extra `tune`.

For `ldcnd.console.commissioning.tuning`, which loads it by the name that the family object gives. Start with `tuning`.
"""
