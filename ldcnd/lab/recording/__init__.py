"""Recordings: what a rig publishes as MCAP files, live in Foxglove, and as tables and plots afterwards.

For operators and analysts, through `ldcnd record`, `plot` and `foxglove`. Start with `recorder`.
"""
