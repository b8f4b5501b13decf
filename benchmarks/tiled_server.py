"""A Tiled server with one array, for comparison: `python benchmarks/tiled_server.py PORT FILE.npy`.

The interpreter needs `tiled[server]`, and no package of this repository.
"""

from __future__ import annotations

import sys

import numpy as np
import uvicorn
from tiled.adapters.array import ArrayAdapter
from tiled.adapters.mapping import MapAdapter
from tiled.config import Authentication
from tiled.server.app import build_app

if __name__ == "__main__":
    tree = MapAdapter({"poses": ArrayAdapter.from_array(np.load(sys.argv[2]))})
    app = build_app(tree, authentication=Authentication(allow_anonymous_access=True))
    uvicorn.run(app, host="127.0.0.1", port=int(sys.argv[1]), log_level="warning")
