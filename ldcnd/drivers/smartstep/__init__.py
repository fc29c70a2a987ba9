"""OMRON SmartStep: the 14-character ASCII protocol."""
