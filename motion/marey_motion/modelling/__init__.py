"""Statistical models of motion: functional data, their principal components, and a distribution."""
