"""Axes as ROS 2 joints: joint states and diagnostics for nodes that use rmw_zenoh, without ROS.

For robots, through `ldcnd ros2`. Start with `bridge`.
"""
