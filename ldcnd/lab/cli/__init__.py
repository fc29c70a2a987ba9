"""The commands of the lab: `record` makes and draws recordings, `serve` shows rigs to others, `top` to a terminal."""
