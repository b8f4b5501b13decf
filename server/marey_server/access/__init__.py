"""Access control: principals, roles, scopes, passwords and token secrets. The database is only used in `store`."""
