"""Inverse kinematics: poses that meet targets of joints, by cyclic coordinate descent, a closed form for two bones, or
damped least squares.
"""
