"""The stages, one a file or folder, found by looking; and the default chain.

A file declares one stage: its methods, their parameters, kernels and NumPy references. Every module
here must define ``STAGE``; code that several stages share belongs in ``reference`` or ``stage``.
It imports ``stage``, ``reference``, ``camera`` and ``base``.
"""

from functools import cache
from importlib import import_module
from pkgutil import iter_modules

from clpipe.stage import Stage

DEFAULT_CHAIN = (
    "exposure",
    "mosaic",
    "inverse_white_balance",
    "prnu",
    "defect_pixels",
    "sensor_noise",
    "dsnu",
    "row_noise",
    "column_noise",
    "quantize",
    "normalize",
    "white_balance",
    "demosaic",
    "denoise",
    "color_matrix",
    "tone_curve",
    "gamma",
    "picture_noise",
)


@cache
def own_stages() -> dict[str, Stage]:
    """clpipe's own stages by name: the default chain first, in its order, then the others."""
    found = {
        module.name: import_module(f"{__name__}.{module.name}").STAGE
        for module in iter_modules(__path__)
    }
    rest = [name for name in found if name not in DEFAULT_CHAIN]
    return {name: found[name] for name in (*DEFAULT_CHAIN, *rest)}
