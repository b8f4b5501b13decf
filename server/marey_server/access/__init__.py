"""Access control: principals, roles, scopes, passwords and token secrets; rules without a database (rows: `store`)."""
