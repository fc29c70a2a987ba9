"""What tests share: the jumping clock, the fake far ends, the rig."""
