"""Spectral response: from the bands of a spectral render to the colours of the sensor."""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np
from pydantic import PrivateAttr

from clpipe.base.types import Floats
from clpipe.camera.profile import SRGB_TO_XYZ
from clpipe.camera.spectra import Sight, band_weights, observer
from clpipe.reference.filter_array import FilterArray, kernel_table, tiled
from clpipe.stage import (
    PERIOD,
    Arguments,
    Bands,
    Context,
    Method,
    Pass,
    ReferenceContext,
    StageRole,
    Unchanged,
    period_of,
    rgb_stage,
)
from clpipe.stages.color_matrix import as_tuples


class SpectralMethod(Method):
    """Sums of the bands of a spectral render; without bands, the image does not change."""

    kernel: ClassVar = "spectral_response"
    overscan: ClassVar = True

    _wavelengths: tuple[float, ...] = PrivateAttr(())

    def resolve(self, context: Context) -> Method:
        if not context.wavelengths:
            return Unchanged()
        return self.with_state(_wavelengths=context.wavelengths)

    def weights(self, context: Context) -> Floats:
        """Return the weights of the sums, (band, 3); the same object for the same values."""
        raise NotImplementedError(type(self).__name__)

    def passes(self) -> tuple[Pass, ...]:
        if not self._wavelengths:
            return ()
        return (Pass("spectral_response", Bands(len(self._wavelengths)), ("weights", "bands")),)

    def arguments(self, context: Context) -> Arguments:
        return {"weights": self.weights(context), "bands": np.uint32(len(self._wavelengths))}

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        total = np.zeros((*image.shape[:2], 3), np.float32)
        for band, weights in enumerate(self.weights(inputs.context)):
            total += image[..., band, None] * weights
        return total


class CameraResponse(SpectralMethod):
    """The camera's white-balanced colours: sums with the sensitivities of its profile.

    A band is constant from half-way to the band before it to half-way to the band after it. Its
    weight is the exact integral of a sensitivity over the band. A white surface in the light of
    ``render.illuminant`` becomes 1 in each colour if its CIE luminance is that of a constant
    spectrum of 1. The matrix back to linear sRGB is fitted to 190 reflectances in this light; see
    :meth:`clpipe.camera.spectra.Sight.to_srgb`.

    If the filter array has other channels than red, green and blue, the three planes are those of
    the array. An array of four channels needs more planes. Each pixel then has only the sum of its
    own filter, so no stage may mix pixels before the mosaic.
    """

    method: ClassVar = "camera"
    summary: ClassVar = "what the camera's filters pass, by the sensitivities in its profile"

    _sites: FilterArray | None = PrivateAttr(None)

    def at_sites(self, array: FilterArray) -> "CameraResponse":
        """Return the method that computes only the sum that each site of an array needs."""
        return self.with_state(_sites=array)

    def next_context(self, context: Context) -> Context:
        if not self._wavelengths or context.sight is None:
            return context
        after = context.replace(planes=planes_of(context.array_ahead))
        if not context.sight.has_colours:
            return after
        return after.replace(colours=as_tuples(np.linalg.inv(context.sight.to_srgb).tolist()))

    def _seen(self, context: Context) -> tuple[Any, ...]:
        """Return the arguments of :func:`_weights`."""
        assert context.sight
        array, planes = context.array_ahead, planes_of(context.array_ahead)
        # Set gains are those of red, green and blue. Other channels keep the sensor's levels.
        gains = context.illuminant_gains if planes == "RGB" else context.sight.gains
        channels = array.channels if self._sites else planes
        return context.sight, self._wavelengths, tuple(channels), gains

    def weights(self, context: Context) -> Floats:
        return _weights(*self._seen(context))

    def passes(self) -> tuple[Pass, ...]:
        if not self._sites:
            return super().passes()
        access = Bands(len(self._wavelengths))
        return (Pass("site_response", access, ("weights", "bands", *PERIOD)),)

    def arguments(self, context: Context) -> Arguments:
        found = super().arguments(context)
        if not self._sites:
            return found
        table = _site_table(self._sites, *self._seen(context))
        return {**found, "weights": table, **period_of(self._sites.period)}

    def reference(self, image: Floats, inputs: ReferenceContext) -> Floats:
        if not self._sites:
            return super().reference(image, inputs)
        by_channel = dict(zip(self._sites.channels, self.weights(inputs.context).T, strict=True))
        total = np.zeros(image.shape[:2], np.float32)
        for band in range(image.shape[2]):
            values = {channel: weights[band] for channel, weights in by_channel.items()}
            total += image[..., band] * tiled(self._sites.by_position(values), image.shape)
        return np.repeat(total[..., None], 3, axis=-1)


def planes_of(array: FilterArray) -> str:
    """Return the channels of the three planes that hold the light of a filter array's filters.

    >>> from clpipe.reference.filter_array import parse_array
    >>> [planes_of(parse_array(name)) for name in ("RGGB", "RCCB", "mono", "RGBW")]
    ['RGB', 'RWB', 'LLL', '']

    Returns:
        Red, green and blue for an array of these; "" if it has too many channels.
    """
    channels = list(array.channels)
    if set(channels) <= set("RGB"):
        return "RGB"
    others = [channel for channel in channels if channel not in "RGB"]
    planes = [c if c in channels else others.pop(0) if others else channels[-1] for c in "RGB"]
    return "" if others else "".join(planes)


@lru_cache(maxsize=64)
def _weights(
    sight: Sight, wavelengths: Sequence[float], channels: Sequence[str], gains: tuple[float, float]
) -> Floats:
    """Return the weights of the bands for channels, of which white is the gain that balances it."""
    weights = sight.weights(wavelengths, channels)
    red, blue = np.array(gains) / sight.gains
    scales = [{"R": red, "B": blue}.get(channel, 1.0) for channel in channels]
    return (weights * scales).astype(np.float32)


@lru_cache(maxsize=64)
def _site_table(array: FilterArray, *seen: Any) -> Floats:
    """Return the :func:`_weights` of the filter at each position, in the layout of kernels."""
    channels = array.channels
    rows = [array.by_position(dict(zip(channels, row, strict=True))) for row in _weights(*seen)]
    return kernel_table(np.stack(rows, axis=1))


@lru_cache(maxsize=16)
def _observer_weights(wavelengths: Sequence[float], in_srgb: bool) -> Floats:
    matrix = np.linalg.inv(SRGB_TO_XYZ) if in_srgb else np.eye(3)
    return (band_weights(observer(), wavelengths) @ matrix.T).astype(np.float32)


class ToXyz(SpectralMethod):
    """CIE XYZ of the 1931 observer, without a sensor. A constant spectrum of 1 has Y = 1."""

    method: ClassVar = "xyz"
    summary: ClassVar = "CIE XYZ, without a sensor"

    def weights(self, context: Context) -> Floats:
        return _observer_weights(self._wavelengths, self.method == ToSrgb.method)


class ToSrgb(ToXyz):
    """Linear sRGB, without a sensor: the spectral render becomes one in RGB. White is D65."""

    method: ClassVar = "srgb"
    summary: ClassVar = "linear sRGB, so that the chain goes on like for a render in RGB"


STAGE = rgb_stage(
    "spectral_response",
    "Add up the bands of a spectral render to the colours of the sensor.",
    (CameraResponse, ToXyz, ToSrgb),
    role=StageRole.SPECTRUM,
)
