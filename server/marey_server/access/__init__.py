"""Access control: principals, roles, scopes, passwords and token secrets. Only `store` uses the database."""
