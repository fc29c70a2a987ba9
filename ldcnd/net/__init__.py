"""Sessions between the daemon and its clients.

Start with `session`, the contract; `zenoh_session` fulfils it, `hand_over` brings
what Zenoh gives to the loop.
"""
