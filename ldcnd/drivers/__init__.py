"""Drive families: what turns exchanges into axis values."""
