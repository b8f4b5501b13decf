"""Pictures of lineage graphs: items, jobs and commits, with arrows from inputs to results."""
