"""The demonstration that `marey demo` runs."""
