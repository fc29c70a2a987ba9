"""The rig page in a terminal: every axis and line at a glance, what is wrong first."""
