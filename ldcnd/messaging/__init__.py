"""Keys, encodings and sessions between the daemon and its clients.

Serves both sides. Start with `session`, the contract; `zenoh_session` and `memory_session` fulfil it, `keys` and
`codec` say what is on it.
"""
