"""Invitations: their creation, their acceptance, and the conditions under which they are valid."""
