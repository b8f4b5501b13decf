"""One module per resource: parse, authorise, call a service, render."""
