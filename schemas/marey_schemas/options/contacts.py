"""Default speeds of a foot in contact with the ground. This module imports nothing, so that kinematics load quickly."""

TOE_SPEED_M_S = 0.15
"""Greatest speed of a planted toe or heel in metres per second, compared in each frame separately."""

STANCE_SPEED_M_S = 0.5
"""Greatest speed of a foot in a stance, in metres per second. Stances are found with hysteresis, because feet roll."""
