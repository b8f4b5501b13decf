"""Motion editing: lists of commands that make one or several clips from one, and leave the original unchanged."""
