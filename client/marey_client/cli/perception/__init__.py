"""Commands about the perception of motion."""
