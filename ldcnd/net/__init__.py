"""Sessions between the daemon and its clients.

Start with `session`, the contract; `zenoh_session` and `memory_session` fulfil it, `hand_over` brings
what Zenoh gives to the loop.
"""
