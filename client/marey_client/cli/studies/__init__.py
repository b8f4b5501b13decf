"""Commands `study`, which carry out perceptual studies."""
