"""Documents of the revisions of items."""
