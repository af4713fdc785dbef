"""Compares clpipe's methods with those of other Python packages, on the same image.

Inputs and outputs are float32 arrays in memory. Each package uses its default number of threads.
Windows have clpipe's sizes: 5x5 for bilateral filters, and 9x9 with patches of 3x3 for non-local
means. scikit-image runs its fast mode.

scikit-image and OpenCV filter RGB; OpenCV's non-local means works in eight bits. clpipe works in
YCbCr, with separate strengths for luma and chroma. The noise of HDRutils and of clpipe is Gaussian
with variance a*y + b, drawn and quantized.
"""

import importlib
import logging
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np

from clpipe.base.types import Array
from clpipe.chain.making import make_chain
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import settings_from
from clpipe.engine.bench import scene
from clpipe.engine.device import Device
from clpipe.engine.runner import Runner
from tools.compare.timing import Comparison, interleaved

SIZE = 1536, 1024  # px: width, height
SIGMA = 0.05  # of the range kernel


@dataclass(frozen=True)
class Other:
    """A method of another package.

    Args:
        package: the name for pip.
        module: the name to import.
        stages: clpipe's stages with their parameters, nested like a configuration.
        make: returns the call, from the module and the image that the first stage reads. The image
            is float32: RGB, (height, width, 3), or an RGGB mosaic, (height, width).
    """

    package: str
    module: str
    stages: Mapping[str, Mapping[str, Any]]
    make: Callable[[Any, Array], Callable[[], object]]

    @property
    def label(self) -> str:
        """clpipe's name of the method, and the other package."""
        name, table = next(iter(self.stages.items()))
        return f"{name} {table['method']}: {self.package}"


def demosaicing(name: str, method: str) -> Other:
    """Return a method of the package colour-demosaicing."""
    return Other(
        "colour-demosaicing",
        "colour_demosaicing",
        {"demosaic": {"method": method}},
        lambda m, y: lambda: getattr(m, f"demosaicing_CFA_Bayer_{name}")(y, "RGGB"),
    )


def hdrutils_noise(module: Any, mosaic: Array) -> Callable[[], object]:
    """Return HDRutils' noise of clpipe's default camera, quantized to 14 bits."""
    logging.getLogger("HDRutils").setLevel(logging.ERROR)
    model = module.NormalNoise("Sony", "ILCE-7RM2", 100)
    return lambda: model.simulate(mosaic, 1)


def opencv_non_local_means(cv2: Any, rgb: Array) -> Callable[[], object]:
    """Return OpenCV's non-local means, which has no float variant."""
    picture = np.rint(np.clip(rgb, 0, 1) * 255).astype(np.uint8)
    h = 255 * SIGMA
    return lambda: cv2.fastNlMeansDenoisingColored(picture, None, h, h, 3, 9)


OTHERS = (
    demosaicing("bilinear", "bilinear"),
    demosaicing("Malvar2004", "malvar2004"),
    demosaicing("Menon2007", "menon2007"),
    Other(
        "scikit-image",
        "skimage.restoration",
        {"denoise": {"method": "bilateral"}},
        lambda m, rgb: (
            lambda: m.denoise_bilateral(
                rgb, win_size=5, sigma_color=SIGMA, sigma_spatial=1.5, channel_axis=-1
            )
        ),
    ),
    Other(
        "opencv-python-headless",
        "cv2",
        {"denoise": {"method": "bilateral"}},
        lambda m, rgb: lambda: m.bilateralFilter(rgb, 5, SIGMA, 1.5),
    ),
    Other(
        "scikit-image",
        "skimage.restoration",
        {"denoise": {"method": "non_local_means"}},
        lambda m, rgb: (
            lambda: m.denoise_nl_means(
                rgb, patch_size=3, patch_distance=4, h=SIGMA, fast_mode=True, channel_axis=-1
            )
        ),
    ),
    Other(
        "opencv-python-headless",
        "cv2",
        {"denoise": {"method": "non_local_means"}},
        opencv_non_local_means,
    ),
    Other(
        "HDRutils",
        "HDRutils",
        {"sensor_noise": {"method": "gaussian"}, "quantize": {}},
        hdrutils_noise,
    ),
)


def imported(other: Other) -> ModuleType | None:
    """Import another package. If it is missing, print a line and return None."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about missing optional parts
            return importlib.import_module(other.module)
    except ImportError as error:
        print(f"{other.label} is skipped: {error}", file=sys.stderr)
        return None


def compare_methods(
    device: Device, repeat: int, others: Sequence[Other] = OTHERS
) -> list[Comparison]:
    """Time the methods whose packages are installed."""
    width, height = SIZE
    rgb = scene(width, height).astype(np.float32)
    mosaic = rgb[..., 1].copy()
    mosaic[::2, ::2], mosaic[1::2, 1::2] = rgb[::2, ::2, 0], rgb[1::2, 1::2, 2]
    rows = []
    for other in others:
        if not (module := imported(other)):
            continue
        stage = all_stages()[next(iter(other.stages))]
        settings = settings_from({"stages": list(other.stages), **other.stages})
        runner = Runner(make_chain(settings, stage.reads), device, encode=False, final=True)
        image = rgb if len(stage.reads.channels) == 3 else mosaic
        works = {
            "ours": lambda runner=runner, image=image: runner.run(image, "compare"),
            "other": other.make(module, image),
        }
        interleaved(works, 1)
        seconds = interleaved(works, repeat)
        theirs = {"other": seconds["other"]}
        rows.append(Comparison(other.label, width * height / 1e6, seconds["ours"], theirs))
    return rows
