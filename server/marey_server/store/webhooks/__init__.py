"""Webhooks of projects, and the work that their deliveries need from the database."""
