"""One line and who uses it: one exchange outstanding, lanes, resynchronisation after a loss.

For drivers, which queue exchanges, and for the daemon, which polls. Start with `bus`, then `line`.
"""
