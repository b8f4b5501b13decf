"""The mathematics of motion: arrays in, arrays out."""
