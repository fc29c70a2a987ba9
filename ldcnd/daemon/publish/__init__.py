"""Everything that the daemon publishes: samples, health, descriptions, and the contract as a list of keys.

Serves subscribers and readers. Start with `publisher.py` for samples, `meta.py` for answers,
`contract.py` for the keys.
"""
