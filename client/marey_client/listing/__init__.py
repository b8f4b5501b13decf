"""Lists of items: tables of what they contain, and messages about paths that do not exist."""
