"""OMRON SmartStep: the 14-character ASCII protocol, one drive a unit number.

Start with `network.py` (a line) and `drive.py` (one drive); `packet.py`,
`addresses.py` and `commands.py` are the protocol, `profiles.py` what the manual leaves open.
"""
