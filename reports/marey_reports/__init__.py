"""Pictures and pages for people: figures and reports of evaluations and models. Used by the worker and by commands that draw."""
