"""The family of SmartSteps as a whole: configuration, plan, tools; its protocol is in drivers/smartstep.

Serves the daemon and the tools through `FAMILIES`. Start with `family.py`.
"""
