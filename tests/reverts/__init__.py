"""Fixes that are taken back one by one in a copy of the checkout, and the tests that must notice each."""
