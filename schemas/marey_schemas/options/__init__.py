"""Options of computations: name, type, range, default and description of each, declared only here."""
