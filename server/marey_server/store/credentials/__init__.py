"""Tokens, their rotation, and limits on sign-ins."""
