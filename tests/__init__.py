"""Tests, from vectors and properties up to real processes."""
