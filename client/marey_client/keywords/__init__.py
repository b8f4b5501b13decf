"""Types of the keyword arguments of methods, for editors and type checkers."""
