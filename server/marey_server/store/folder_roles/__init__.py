"""Roles of members in folders of a project, which owners set, and the rights that members get from these roles."""
