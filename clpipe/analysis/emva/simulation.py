"""Simulates a series of a camera: uniform light through the raw stages of a chain."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from clpipe.analysis.emva.sensor import noisiest_light
from clpipe.analysis.emva.series import NAME, NS, PAIR, Exposure, Series, series_text
from clpipe.base.errors import RequestError
from clpipe.base.files import check_folder, create_parents, write_new
from clpipe.camera.profile import Camera, load_camera
from clpipe.chain.identity import image_key, noise_key
from clpipe.chain.making import make_chain
from clpipe.chain.registry import stage_in
from clpipe.chain.settings import Settings, overlay
from clpipe.engine.device import Device
from clpipe.engine.service import Service, picture
from clpipe.images.write import write_png
from clpipe.stage import StageRole

BEYOND = 0.1  # number of exposures above saturation, relative to the number below it
SATURATED = 0.01  # s; the exposure time at which the light saturates the sensor
SHARE = 0.5  # exposure of the PRNU stack, relative to saturation


@dataclass(frozen=True)
class SeriesSize:
    """The size of a series: px of a frame, exposures up to saturation, frames of a stack."""

    width: int = 640
    height: int = 480
    exposures: int = 50
    stack: int = 100


def saturation_of(camera: Camera, iso: float) -> float:
    """Return the electrons at which a camera's noise is largest. Errors: :meth:`Camera.noise`."""
    noise, unit = camera.noise(iso), camera.signal_range
    gain = noise.a * unit
    full = min(unit, gain * camera.full_well) if camera.full_well else unit
    return noisiest_light(gain, noise.b**0.5 * unit, camera.prnu, full)


def simulate(
    camera: str,
    iso: float | None,
    seed: int,
    folder: Path,
    size: SeriesSize,
    device: Device | None,
    watch: Callable[[int, int], None] = lambda done, of: None,
) -> Series:
    """Make a series of a camera: frames as PNG, and finally the text that describes them.

    All pixels of the mosaic receive the same light, after the colour filters. The stages from
    ``crosstalk`` to ``quantize`` process it.

    Args:
        camera: a name, or the file of a profile.
        iso: its ISO; None is the lowest.
        seed: the seed of the noise.
        folder: the folder for the series.
        size: the size of the series.
        device: the device that computes it; None is NumPy.
        watch: called after each frame with the number of finished frames, and of all frames.

    Raises:
        RequestError: there is no such camera or ISO, or the folder has a series.
        ImageError: a file cannot be written.
    """
    sensor = load_camera(camera)
    check_folder(folder)
    text = folder / NAME
    if text.exists():
        raise RequestError(f"{text}: this folder already contains a series; choose another folder")
    values = {"camera": camera, "iso": sensor.iso_range[0] if iso is None else iso, "seed": seed}
    settings = overlay(Settings(), values)
    efficiency = sensor.quantum_efficiency or 1.0
    series = _plan_exposures(text, sensor, saturation_of(sensor, settings.iso) / efficiency, size)
    photon = sensor.signal_of(efficiency, settings.iso)
    service = Service([device])
    exposures = (*series.bright, *series.dark, series.bright_stack, series.dark_stack)
    total, done = sum(len(each.frames) for each in exposures), 0
    samples = np.uint8 if series.bits <= 8 else np.uint16
    first, last = (stage_in(role).name for role in (StageRole.SENSOR, StageRole.RAW))
    for exposure in exposures:
        chain = make_chain(_simulate_exposure(settings, exposure), start_at=first, until=last)
        light = np.full((size.height, size.width), photon * exposure.photons, np.float32)
        for frame in exposure.frames:
            key = noise_key(settings, image_key(frame.relative_to(folder).as_posix(), ""))
            create_parents(frame)
            write_png(frame, service.run(picture(chain, light, key)).image.astype(samples))
            done += 1
            watch(done, total)
    comment = f"A series of the camera {sensor.name} at ISO {settings.iso:g}, made by clpipe emva."
    if not sensor.quantum_efficiency:
        comment += "\nIts quantum efficiency is not known: photons are electrons."
    write_new(text, series_text(series, comment).encode())
    return series


def _simulate_exposure(settings: Settings, exposure: Exposure) -> Settings:
    """Return the settings with an exposure's time, which determines the dark charge."""
    return overlay(settings, {"dark_current": {"exposure_time": exposure.time / NS}})


def _plan_exposures(path: Path, camera: Camera, saturation: float, size: SeriesSize) -> Series:
    """Return the exposures of a series, with the paths of its frames.

    Args:
        path: the path of the text.
        camera: the camera.
        saturation: the photons at saturation.
        size: the size of the series.
    """
    last = size.exposures + math.ceil(size.exposures * BEYOND)
    steps = np.arange(1, last + 1) / size.exposures

    def exposure(share: float, photons: float, name: str, count: int) -> Exposure:
        frames = [path.parent / "images" / f"{name}_{number:03}.png" for number in range(count)]
        return Exposure(round(share * SATURATED * NS), float(f"{photons:.9g}"), tuple(frames))

    bright, dark = (
        tuple(
            exposure(share, lit * share * saturation, f"{letter}_{number:03}", PAIR)
            for number, share in enumerate(steps)
        )
        for letter, lit in (("b", 1), ("d", 0))
    )
    return Series(
        path=path,
        bits=max(camera.bits, 8),
        width=size.width,
        height=size.height,
        bright=bright,
        dark=dark,
        bright_stack=exposure(SHARE, SHARE * saturation, "b_stack", size.stack),
        dark_stack=exposure(SHARE, 0.0, "d_stack", size.stack),
    )
