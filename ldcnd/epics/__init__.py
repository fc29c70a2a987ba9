"""Axes as EPICS motor records: a gateway between a rig and Channel Access clients."""
