"""Motion matching: search for the frame in a set of clips that best continues a motion along a desired trajectory.

Conventions are those of `marey_motion.kinematics`; ground positions are (x, z) in metres, headings grow to the left.
"""
