"""Pictures and pages for people: figures and reports of evaluations, models, differences and lineage."""
