"""Inverse kinematics: poses that meet targets of joints, by coordinate descent, two bones, or damped least squares."""
