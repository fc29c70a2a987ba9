"""Other people's worlds and records: Bluesky, EPICS, ROS 2, recordings, metrics, and the view of a terminal.

Each stands on the client and can be deleted without the others.
"""
