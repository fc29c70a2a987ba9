"""The rig in a terminal: every axis and line at a glance, what is wrong first.

For operators, through `ldcnd top`. Start with `screen`; `rig_view` draws.
"""
