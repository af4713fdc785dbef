"""The stages, one per file or folder, and the default chain.

Each file declares one stage: its methods, their parameters, kernels and NumPy references. Every
module here must define ``STAGE``; :func:`built_in_stages` imports them all, so no other list
exists. Code that several stages share belongs in ``reference`` or ``stage``. This package imports
``images``, ``stage``, ``reference``, ``camera`` and ``base``.
"""

from functools import cache
from importlib import import_module
from pkgutil import iter_modules

from clpipe.stage import Stage

DEFAULT_CHAIN = (
    "projection",
    "shutter",
    "defocus",
    "motion_blur",
    "distortion",
    "vignetting",
    "inverse_color_matrix",
    "glare",
    "optical_blur",
    "exposure",
    "mosaic",
    "inverse_white_balance",
    "crosstalk",
    "prnu",
    "defect_pixels",
    "blooming",
    "sensor_noise",
    "dark_current",
    "random_telegraph",
    "dsnu",
    "dark_shading",
    "row_noise",
    "column_noise",
    "banding",
    "black_level_error",
    "quantize",
    "normalize",
    "white_balance",
    "demosaic",
    "denoise",
    "color_matrix",
    "sharpen",
    "tone_curve",
    "gamma",
    "picture_noise",
)


@cache
def built_in_stages() -> dict[str, Stage]:
    """Return clpipe's built-in stages by name: the default chain in its order, then the others."""
    stages: dict[str, Stage] = {
        module.name: import_module(f"{__name__}.{module.name}").STAGE
        for module in iter_modules(__path__)
    }
    others = [name for name in stages if name not in DEFAULT_CHAIN]
    return {name: stages[name] for name in (*DEFAULT_CHAIN, *others)}
