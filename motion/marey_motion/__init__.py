"""The mathematics of motion: arrays in, arrays out.

`__init__.pyi` lists the exported names with their modules. A module is loaded when one of its names is first used.
Importing the package therefore takes hardly any time, and compiled kernels are loaded only when they are needed.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
