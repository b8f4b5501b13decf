"""How likely examples are under mixtures that have not seen them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from marey_motion.modelling.mixture_fitting import FittedMixture, MixtureOptions, fit_mixture
from marey_motion.modelling.options import ModelOptions

Floats = NDArray[np.float64]


def held_out_log_densities(latents: Floats, fitted: FittedMixture, options: ModelOptions, *, seed: int) -> Floats:
    """ln p of each example (m,) under a mixture of as many components, fitted to the other folds.

    The latent space stays: of all examples. What is held out is the distribution in it, so that the numbers can be
    compared with the likelihood of training.
    """
    examples = len(latents)
    folds = np.random.Generator(np.random.Philox(seed)).permutation(examples) % options.folds
    refit = MixtureOptions(
        components=len(fitted.mixture.weights), regularisation=options.regularisation, starts=options.starts
    )
    densities = np.empty(examples)
    for fold in range(options.folds):
        held = folds == fold
        densities[held] = fit_mixture(latents[~held], refit, seed=seed).mixture.log_density(latents[held])
    return densities
