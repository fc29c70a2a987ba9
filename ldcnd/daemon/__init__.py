"""The daemon: the one place where lines, axes and clients meet.

It serves one rig over one session. Start with `daemon.py`. A query goes from `requests.py` to
`dispatch.py`, its command to the axis and from there to the drive; a reading goes from `line.py` to the axis and from
there to the publisher.
"""
