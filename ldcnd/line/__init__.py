"""One RS-485 line: its port, one exchange outstanding, lanes, resynchronisation after a loss, its flight recorder.

For drives, which queue exchanges, and for the daemon, which polls. Start with `bus`, then `line`.
"""
