"""Typed access to a running daemon; contains the contract, not the machine."""
