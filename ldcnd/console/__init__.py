"""The rig in a browser: a Zenoh client of its own process that serves pages."""
