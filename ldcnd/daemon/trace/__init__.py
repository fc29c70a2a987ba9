"""Traces of one axis: by its drive's recorder or by polling.

Serves `axis`. Start with `recorder.py`: armed, recorded, published.
"""
