"""All that crosses the network: commands, samples, descriptions, keys, errors and the one encoding.

For the daemon, its clients and the schemas. Start with `commands` and `samples`; `catalogue` lists all models,
`codec` encodes them, `keys` says where they are.
"""
