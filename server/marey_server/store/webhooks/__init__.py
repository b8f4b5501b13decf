"""Webhooks of projects, and the database side of their deliveries."""
