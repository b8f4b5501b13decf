"""Documents that the revisions of items are made of."""
