"""The one place where buses, drives and clients meet."""
