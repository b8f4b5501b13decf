"""What travels between the parts of Marey: documents and their codecs."""
