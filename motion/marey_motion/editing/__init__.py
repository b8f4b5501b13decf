"""Motion editing: lists of commands that make one or several clips of one, and leave the original as it was."""
