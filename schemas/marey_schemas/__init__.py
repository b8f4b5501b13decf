"""Documents that the parts of Marey exchange, and their codecs."""
