"""Axes as EPICS motor records: a gateway between a rig and Channel Access clients.

For laboratories with EPICS, through `ldcnd epics`. Start with `gateway`, then `motor`.
"""
