"""SQLite and Postgres: connections, the queue of writing transactions, prepared statements, schema, and clock."""
