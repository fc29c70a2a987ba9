"""The family of LDCN and NMC drives as a whole: configuration, plan, examination; its protocol is in drivers/ldcn.

Start at `family.py`.
"""
