"""Default speeds of a foot in contact with the ground. Imports nothing, so that kinematics load quickly."""

TOE_SPEED_M_S = 0.15
"""Greatest speed of a joint in contact, frame by frame: a planted toe or heel."""

STANCE_SPEED_M_S = 0.5
"""Greatest speed of a foot in a stance, which is found with hysteresis while the foot rolls."""
