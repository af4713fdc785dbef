"""Methods of other Python packages beside clpipe's of the same name, on the same image.

Arrays in memory to arrays in memory, in float32, with the default threads of each. Windows are as
clpipe's: 5x5 for the bilateral filters, 9x9 with patches of 3x3 for non-local means, which
scikit-image runs in its fast mode. scikit-image's and OpenCV's filter RGB, OpenCV's non-local means
in eight bits; clpipe's work in YCbCr, with a strength for luma and one for chroma. HDRutils' noise
and clpipe's are Gaussian of variance a*y + b, drawn and quantized.
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
from tools.compare.turns import Comparison, in_turns

SIZE = 1536, 1024  # px: width, height
SIGMA = 0.05  # of differences in value


@dataclass(frozen=True)
class Other:
    """A method of another package.

    Args:
        package: as it is installed.
        module: what is imported.
        stages: clpipe's, with the parameters, nested as in a configuration.
        make: makes the call from the module and the image, which the first stage reads: RGB,
            (height, width, 3), or an RGGB mosaic, (height, width), float32.
    """

    package: str
    module: str
    stages: Mapping[str, Mapping[str, Any]]
    make: Callable[[Any, Array], Callable[[], object]]

    @property
    def label(self) -> str:
        """The method, as clpipe calls it, and whose the other one is."""
        name, table = next(iter(self.stages.items()))
        return f"{name} {table['method']}: {self.package}"


def demosaicing(name: str, method: str) -> Other:
    """A function of colour-demosaicing."""
    return Other(
        "colour-demosaicing",
        "colour_demosaicing",
        {"demosaic": {"method": method}},
        lambda m, y: lambda: getattr(m, f"demosaicing_CFA_Bayer_{name}")(y, "RGGB"),
    )


def hdrutils_noise(module: Any, mosaic: Array) -> Callable[[], object]:
    """HDRutils' noise of clpipe's default camera, quantized to 14 bits."""
    logging.getLogger("HDRutils").setLevel(logging.ERROR)
    model = module.NormalNoise("Sony", "ILCE-7RM2", 100)
    return lambda: model.simulate(mosaic, 1)


def opencv_non_local_means(cv2: Any, rgb: Array) -> Callable[[], object]:
    """OpenCV's non-local means, which has no float variant."""
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
    """The module of another package; None, with a line on stderr, where it is not there."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of optional parts that are missing
            return importlib.import_module(other.module)
    except ImportError as error:
        print(f"{other.label} is left out: {error}", file=sys.stderr)
        return None


def compare_methods(
    device: Device, repeat: int, others: Sequence[Other] = OTHERS
) -> list[Comparison]:
    """Time the methods whose packages are there."""
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
        in_turns(works, 1)
        seconds = in_turns(works, repeat)
        theirs = {"other": seconds["other"]}
        rows.append(Comparison(other.label, width * height / 1e6, seconds["ours"], theirs))
    return rows
