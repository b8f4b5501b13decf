"""The perceptual metric of Pražák et al.: how different two poses, or two clips of locomotion, look to people."""
