"""Trees over samples of a model: part `tree` of an item of the kind `model`."""

from __future__ import annotations

from typing import Annotated, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from marey_schemas.base import Request
from marey_schemas.documents.references import PartDigestRef
from marey_schemas.encoding.arrays import ArrayOf
from marey_schemas.names import Digest
from marey_schemas.options.modelling import MOST_TREE_SAMPLES, TreeOptions
from marey_schemas.sizes import SEEDS


class SampleTreeDocument(Request):
    """Part `tree` of a model: samples of the model, grouped by recursive k-means.

    Nodes are stored level by level from the root; the children of a node are adjacent, and each child has a contiguous
    range of its parent's samples. A node without children is a leaf.
    """

    schema_: Literal["marey/sample-tree@1"] = Field("marey/sample-tree@1", alias="schema")
    model_digest: Digest | PartDigestRef = Field(
        description="Digest of the part `model` that the samples were drawn from; the tree is valid for no other model."
    )
    seed: int = Field(ge=0, lt=SEEDS, description="Seed that the samples were drawn with.")
    options: TreeOptions
    samples: Annotated[NDArray[np.float32], ArrayOf("<f4", ndim=2)] = Field(
        description="[n, L] latent vectors of the samples."
    )
    sizes: Annotated[NDArray[np.int32], ArrayOf("<i4", ndim=1)] = Field(
        description="[M] number of samples below each node."
    )
    children: Annotated[NDArray[np.int32], ArrayOf("<i4", ndim=1)] = Field(
        description="[M] number of children of each node."
    )

    @model_validator(mode="after")
    def _check_shapes(self) -> Self:
        if len(self.sizes) != len(self.children):
            raise ValueError(
                f"children: there are {len(self.children)} values for {len(self.sizes)} nodes; each node needs one"
            )
        if not len(self.sizes) or self.sizes[0] != len(self.samples):
            raise ValueError(f"sizes: the first node must contain all {len(self.samples)} samples")
        if len(self.samples) > MOST_TREE_SAMPLES:
            raise ValueError(
                f"samples: the tree has {len(self.samples):,} samples; at most {MOST_TREE_SAMPLES:,} are accepted"
            )
        return self
