"""Commands for users, their tokens and their invitations."""
