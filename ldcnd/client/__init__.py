"""The Python client: typed access to a running daemon.

For programs, through `ldcnd.connect`; gateways, the console and the command line stand on it too. Start with `rig`,
then `axis`; below them is `rig_client`, which asks and decodes.
"""
