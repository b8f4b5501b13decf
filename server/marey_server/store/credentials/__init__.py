"""Tokens and their rotation, limits on sign-ins, and sign-ins with an identity provider."""
