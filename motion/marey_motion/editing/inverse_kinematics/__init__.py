"""Inverse kinematics: poses in which joints meet given targets.

The solvers are cyclic coordinate descent, a closed form for two bones, and damped least squares.
"""
