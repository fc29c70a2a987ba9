"""The commands of the bench: `commission` brings an axis into service, `examine` uses a port itself."""
