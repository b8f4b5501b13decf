"""Access control: principals, roles, scopes, passwords and token secrets. Pure rules; the rows are in `store`."""
