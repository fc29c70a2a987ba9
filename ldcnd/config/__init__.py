"""The configuration file: what a rig, its lines, its axes and its simulated lines are, validated whole.

For the daemon, `check-config` and the reference. Start with `rig`.
"""
