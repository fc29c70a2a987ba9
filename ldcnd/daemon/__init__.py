"""The daemon: the one place where lines, drives and clients meet.

Serves one rig over one session. Start with `process/daemon.py`. A command goes from `command/dispatch.py` to
`axis/axis.py` and from there to the driver; a reading goes from `line/line.py` to `axis/axis.py` to `publish`.
"""
