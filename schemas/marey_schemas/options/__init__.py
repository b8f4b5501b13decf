"""Options: the one declaration of name, type, range, default and meaning of everything that can be chosen."""
