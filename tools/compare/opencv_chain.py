"""clpipe's default chain in OpenCV and NumPy, as an experienced user would write it.

It takes its parameters from clpipe's own chain. These functions replace the stages:

- optical_blur: cv2.sepFilter2D with the same weights.
- exposure, mosaic, inverse_white_balance: a strided copy from the render and one gain for each
  colour of the pattern.
- sensor_noise, row_noise: cv2.randn, times the square root of a*y + b. It is three times faster
  than NumPy's generators.
- quantize: cv2.addWeighted into 16 bits, which rounds and saturates.
- normalize, white_balance: cv2.LUT on the 16-bit raw, with one table for each colour. The tables
  return the square root of the signal in 16 bits, on which all later steps work.
- demosaic: OpenCV's edge-aware demosaicing (COLOR_Bayer*_EA).
- denoise: cv2.bilateralFilter on float luma and chroma, with the same share of grain. It has 4
  neighbours in luma and 12 in each chroma; ``biweight`` has 8 in each. cv2.bilateralFilter on three
  channels would cost twice as much.
- sharpen: an unsharp mask with the same sigma, amount and limit.
- tone_curve: a table of the contraharmonic mean of the colours, with cv2.LUT. gamma and
  quantization to eight bits: another table.

It does less than clpipe:

- The noise has no seed, and depends on the machine.
- Demosaicing has no bounds for red and blue, so edges have fringes. Green follows the direction
  with the smaller gradient.
- Sharpening adds to luma, and does not scale the colours.
- It skips the camera's colours (inverse_color_matrix, color_matrix), so its colour noise differs.
- It does not clip to a display, has no tiles, and only accepts even sizes.
"""

import math
import os
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import cv2
import numpy as np

from clpipe.base.types import Array, Floats
from clpipe.chain.chain import Chain
from clpipe.reference.curve import to_8_bit
from clpipe.reference.transfer import srgb_curve

CODES = 65536  # of 16 bits
TOP = CODES - 1
BLUR_HALO = 4  # rows around a band that the blur may read, at least
HALO = 8  # rows around a band that demosaicing, denoising and sharpening read
BAND = 500_000  # pixels, most of which fit into the cache; found by experiment

Each = Callable[[Callable[[int], None], Iterable[int]], Iterable[None]]  # such as map


def pool(threads: int) -> ThreadPoolExecutor:
    """Return a pool whose threads have differently seeded generators of OpenCV."""
    return ThreadPoolExecutor(
        threads, initializer=lambda: cv2.setRNGSeed(int.from_bytes(os.urandom(3)))
    )


class OpenCVChain:
    """The default chain with the parameters of a resolved chain.

    Args:
        chain: clpipe's chain.
        bgr: whether pictures are in OpenCV's order of channels, blue first.
    """

    def __init__(self, chain: Chain, bgr: bool = False) -> None:
        of: dict[str, Any] = {step.name: step.method for step in chain.steps}
        before, after = of["inverse_white_balance"], of["white_balance"]
        levels, noise = of["quantize"], of["sensor_noise"]
        side = of["optical_blur"].arguments(chain.steps[0].context)["weights"]
        self.spread = np.concatenate([side[:0:-1], side])
        gain = float(of["exposure"].gain)
        self.gains = gain / before.red_gain, gain, gain / before.blue_gain
        self.a, self.b, self.row_sigma = noise.a, noise.b, of["row_noise"].sigma
        self.black, self.white = levels.black_level, levels.white_level

        denoise, sharpen = of["denoise"], of["sharpen"]
        offset = denoise.offset
        root_of_top = math.sqrt(max(after.red_gain, 1.0, after.blue_gain) + offset)
        signal = (np.arange(CODES) - self.black) / (self.white - self.black)

        def roots(gain: float) -> Array:
            root = np.sqrt(np.maximum(signal * gain + offset, 0)) / root_of_top
            return np.minimum(np.rint(root * TOP), TOP).astype(np.uint16)

        red, green, blue = map(roots, (after.red_gain, 1.0, after.blue_gain))
        # Two pixels of a row are two channels, so one table serves both colours of the row.
        self.row_tables = np.stack([red, green], -1)[None], np.stack([green, blue], -1)[None]
        # A Gaussian whose sigma is a third of the range nearly has the shape of the biweight.
        self.luma_sigma, self.chroma_sigma = (r / root_of_top / 3 for r in denoise.ranges)
        self.grain = denoise.grain
        self.radius, self.amount = sharpen.radius, np.float32(sharpen.amount)
        self.limit = np.float32(sharpen.limit / root_of_top)
        light = np.clip((np.arange(CODES) / TOP * root_of_top) ** 2 - offset, 0, 1)
        self.light, style = np.float32(light), of["tone_curve"]
        # The factor of all colours, by their contraharmonic mean.
        mean = np.float32(np.maximum(np.arange(CODES), 1) / TOP)
        self.factor = np.float32(style.curve(mean) / mean)
        self.display = to_8_bit(np.float32(srgb_curve(np.arange(CODES) / TOP)))
        self.to_colours = cv2.COLOR_YCrCb2BGR if bgr else cv2.COLOR_YCrCb2RGB

    def blur(self, render: Array) -> Floats:
        """Blur a render like the lens: (height, width, 3) half or float to float32."""
        light = render.astype(np.float32)
        return cv2.sepFilter2D(light, -1, self.spread, self.spread, light)

    def expose(self, render: Floats) -> Array:
        """Simulate the raw of a blurred render: (height, width, 3) to (height, width) uint16."""
        height, width = render.shape[:2]
        y = np.empty((height, width), np.float32)
        for row, colours in enumerate(((0, 1), (1, 2))):  # of RGGB
            for column, colour in enumerate(colours):
                y[row::2, column::2] = render[row::2, column::2, colour]
            gains = np.float32([self.gains[colour] for colour in colours])
            y[row::2] *= np.tile(gains, width // 2)
        noise, sigma = np.empty_like(y), cv2.addWeighted(y, self.a, y, 0, self.b)
        cv2.randn(noise, 0, 1)
        np.maximum(sigma, 0, out=sigma)
        cv2.sqrt(sigma, sigma)
        sigma *= noise
        y += sigma
        rows = np.empty((height, 1), np.float32)
        cv2.randn(rows, 0, self.row_sigma)
        y += rows
        raw = cv2.addWeighted(y, self.white - self.black, y, 0, self.black, dtype=cv2.CV_16U)
        return np.minimum(raw, np.uint16(self.white), out=raw)

    def develop(self, raw: Array) -> Array:
        """Develop a raw into a picture, (height, width, 3) uint8."""
        height, width = raw.shape
        roots = np.empty_like(raw)
        for row, table in enumerate(self.row_tables):
            pairs = height // 2, width // 2, 2
            cv2.LUT(raw[row::2].reshape(pairs), table, roots[row::2].reshape(pairs))
        planes = cv2.cvtColor(roots, cv2.COLOR_BayerRGGB2RGB_EA)
        cv2.cvtColor(planes, cv2.COLOR_RGB2YCrCb, planes)
        unit = np.float32(1 / TOP)
        y, cr, cb = (np.multiply(planes[..., i], unit, dtype=np.float32) for i in range(3))
        smooth = cv2.bilateralFilter(y, 3, self.luma_sigma, 1)
        cv2.addWeighted(y, self.grain, smooth, 1 - self.grain, 0, y)
        cr = cv2.bilateralFilter(cr, 5, self.chroma_sigma, 1.5)
        cb = cv2.bilateralFilter(cb, 5, self.chroma_sigma, 1.5)
        self._sharpen(y)
        merged = cv2.merge([self._codes(plane) for plane in (y, cr, cb)])
        cv2.cvtColor(merged, self.to_colours, merged)
        colours = [cv2.LUT(codes, self.light) for codes in cv2.split(merged)]
        total = colours[0] + colours[1]
        total += colours[2]
        squares = colours[0] * colours[0]
        cv2.accumulateSquare(colours[1], squares)
        cv2.accumulateSquare(colours[2], squares)
        factor = cv2.LUT(self._codes(cv2.divide(squares, total)), self.factor)
        styled = (cv2.multiply(light, factor, light) for light in colours)
        return cv2.merge([cv2.LUT(self._codes(light), self.display) for light in styled])

    def _sharpen(self, y: Floats) -> None:
        detail = cv2.GaussianBlur(y, (9, 9), self.radius)
        np.subtract(y, detail, out=detail)
        detail *= self.amount
        np.clip(detail, -self.limit, self.limit, out=detail)
        y += detail

    @staticmethod
    def _codes(plane: Floats) -> Array:
        return cv2.addWeighted(plane, TOP, plane, 0, 0, dtype=cv2.CV_16U)

    def run(self, render: Array) -> Array:
        """Process a whole render: (height, width, 3) uint8."""
        return self.develop(self.expose(self.blur(render)))

    def run_in_bands(self, render: Array, each: Each = map) -> Array:
        """Process a render in bands of rows; ``each`` may be a pool's map."""
        height, width = render.shape[:2]
        rows = max(BAND // width, 4 * HALO) // 2 * 2
        raw = np.empty((height, width), np.uint16)
        picture = np.empty((height, width, 3), np.uint8)

        def expose(top: int) -> None:
            above = max(top - BLUR_HALO, 0)
            light = self.blur(render[above : top + rows + BLUR_HALO])
            raw[top : top + rows] = self.expose(light[top - above :][:rows])

        def develop(top: int) -> None:
            above = max(top - HALO, 0)
            band = self.develop(raw[above : top + rows + HALO])
            picture[top : top + rows] = band[top - above :][:rows]

        for work in (expose, develop):
            list(each(work, range(0, height, rows)))
        return picture
