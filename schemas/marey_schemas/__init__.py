"""Documents that travel between the parts of Marey, and their codecs."""
