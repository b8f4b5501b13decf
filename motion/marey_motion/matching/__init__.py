"""Motion matching: which frame of a set of clips continues a motion best towards a wished trajectory.

Conventions are those of `marey_motion.kinematics`; ground positions are (x, z) in metres, headings grow to the left.
"""
