"""Roles of members in folders of a project: what owners set, and the rights that follow."""
