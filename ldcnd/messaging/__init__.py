"""Keys, encodings and sessions: the road between the daemon and its clients."""
