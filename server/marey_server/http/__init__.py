"""HTTP machinery that every resource uses: declarations, negotiation, preconditions, bodies, and replies."""
