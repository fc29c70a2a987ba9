"""ldcnd owns RS-485 servo lines and exposes their drives over Zenoh."""
