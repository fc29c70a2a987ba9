"""LDCN and NMC drives on the bench: a line scanned, examined, its drives tried. Start with `family`."""
