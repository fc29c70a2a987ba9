"""The family of LDCN and NMC drives as a whole: configuration, plan, examination; its protocol is in drivers/ldcn.

Serves the daemon and the tools through `FAMILIES`. Start with `family.py`.
"""
