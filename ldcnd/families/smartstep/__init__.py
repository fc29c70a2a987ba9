"""The family of SmartSteps as a whole: configuration, plan, tools; its protocol is in drivers/smartstep.

Start at `family.py`.
"""
