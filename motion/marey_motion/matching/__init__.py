"""Motion matching: search for the frame in a set of clips that best continues a motion along a desired trajectory.

The conventions of `marey_motion.kinematics` apply. Ground positions are (x, z) in metres, and a left turn increases the
heading.
"""
