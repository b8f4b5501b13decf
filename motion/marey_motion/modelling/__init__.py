"""Statistical models of motion: aligned examples become functional data, their principal components a distribution."""
