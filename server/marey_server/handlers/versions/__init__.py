"""Resources of versions: datasets with their commits and branches, proposals, and differences of revisions."""
