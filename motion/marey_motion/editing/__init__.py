"""Motion editing: lists of commands that make one or several new clips from a clip, which itself stays unchanged."""
