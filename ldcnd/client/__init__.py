"""Typed access to a running daemon; knows the contract, not the machine."""
