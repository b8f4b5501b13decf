"""Quotas: limits on what one user, or one project, may have."""
