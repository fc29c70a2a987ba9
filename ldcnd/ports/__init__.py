"""Ports on which existing host software shares a line with the daemon's clients.

A wing: deleting this folder breaks nothing else.
"""
