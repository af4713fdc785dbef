"""The EXIF of a picture: its camera, and how it was exposed."""

from collections.abc import Mapping
from dataclasses import replace
from datetime import datetime, timedelta

import numpy as np

from clpipe.chain.chain import Chain, Step
from clpipe.chain.photometry import Estimates, exposure_of
from clpipe.images.encoding import DATE
from clpipe.images.read import SourceImage
from clpipe.images.tags import TAG_ATTRIBUTES, Tags, exposed_attributes
from clpipe.reference.geometry import Scaling
from clpipe.stage import StageRole

FIRST_DATE, DATES = datetime(2020, 1, 1, 12), 3650  # of renders without a date; number of days


def tags_of(chain: Chain, source: SourceImage, tags: Tags, estimates: Estimates) -> Tags:
    """Return the tags of a picture. Values of the request take precedence over the image's.

    A positive EV is recorded as a longer exposure time. A render without a date gets one that
    follows from the seed, because programs sort and group photographs by their dates.
    """
    optics, stated_values = chain.optics, {**source.shot, **tags.shot}
    time, bias = optics.exposure_time or stated_values.get("exposure_time"), tags.bias
    if exposed := exposure_of(chain, estimates):
        bias = exposed.ev
        time = exposed.time or (time and time * 2.0**bias)
    elif bias is not None:  # the image was kept after the exposure step
        time = tags.exposure
    calibration = optics.calibration
    return replace(
        tags,
        exposure=time,
        bias=bias,
        lens=calibration.name if calibration else tags.lens,
        focus_distance=optics.focus_distance or tags.focus_distance,
        aperture=optics.f_number or tags.aperture,
        focal_length=optics.focal_length or stated_values.get("focal_length"),
        sensor_width=sensor_width_of(chain, source, stated_values),
        taken=chain.settings.output.date or tags.taken or date_of(chain.seed),
        encoding=chain.settings.output,
    )


def date_of(seed: int) -> str:
    """Return a date in EXIF's format for a seed, one day later for each.

    >>> date_of(0), date_of(31)
    ('2020:01:01 12:00:00', '2020:02:01 12:00:00')
    """
    return f"{FIRST_DATE + timedelta(days=seed % DATES):{DATE}}"


def sensor_width_of(
    chain: Chain, source: SourceImage, stated_values: Mapping[str, float]
) -> float | None:
    """Return the width of a picture's sensor in mm, along the longer side; None if not known.

    The width is given, or computed from the focal length in mm and in px.

    Args:
        chain: the chain of the picture.
        source: the image, as it was loaded.
        stated_values: values in the image's metadata.
    """
    optics = chain.optics
    stated = None if optics.has_lens_sensor else optics.sensor_width
    if stated := stated or stated_values.get("sensor_width"):
        return stated
    focal_length = optics.focal_length or stated_values.get("focal_length")
    if focal_length is None or source.pixels.ndim != 3:
        return None
    width, height = source.margins.frame_size(*source.pixels.shape[1::-1])
    camera = chain.intrinsics_of_render(width, height, source.shot)
    return focal_length / camera.fx * max(width, height) if camera else None


def tags_after(chain: Chain, source: SourceImage, tags: Tags) -> Tags:
    """Return the tags of a chain's output. Binning may discard the edge of the sensor.

    Args:
        chain: the chain of the image.
        source: the input of the chain.
        tags: the tags, with the width of the whole sensor.
    """
    if not tags.sensor_width or not chain.geometry:
        return tags
    size = source.pixels.shape[1::-1]
    long_axis, fraction = int(np.argmax(size)), 1.0
    for part in chain.geometry.parts:
        if isinstance(part, Scaling):
            fraction *= part.shown(*size)[long_axis] / size[long_axis]
        size = part.size(*size)
    return replace(tags, sensor_width=tags.sensor_width * fraction)


def kept_tags(chain: Chain, step: Step, source: SourceImage, tags: Tags) -> dict[str, str]:
    """Return the attributes of a step's image that contain the tags of its source.

    After the exposure step they contain the exposure as well, so that a picture made from the image
    has the same EXIF.

    Args:
        chain: the chain of the picture.
        step: one of its steps.
        source: the input of the chain.
        tags: the tags of the picture.
    """
    stated_values = {
        name: source.attributes[name] for name in TAG_ATTRIBUTES if name in source.attributes
    }
    exposure = chain.step_in(StageRole.EXPOSURE)
    if exposure is None or chain.steps.index(step) < chain.steps.index(exposure):
        return stated_values
    return stated_values | exposed_attributes(stated_values, tags)
