"""Connections to SQLite and Postgres: the clock, the write lane, prepared statements, and the schema."""
