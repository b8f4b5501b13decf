"""Poses that meet what is asked of joints: by coordinate descent, two bones, or damped least squares."""
