"""Quality of motion: foot skate, contacts, penetration, jitter, joint limits, speed and turn rate of any clip."""
