"""Benchmarks of a chain on a device, per launch, compared with the device's copy speed."""

import time
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np

from clpipe.base.errors import RequestError
from clpipe.base.types import Array
from clpipe.chain.chain import Chain
from clpipe.chain.making import make_chain
from clpipe.chain.settings import Settings
from clpipe.engine.device import Device
from clpipe.engine.ir import Launch
from clpipe.engine.options import RunOptions, Timing
from clpipe.engine.runner import Runner
from clpipe.engine.traffic import bytes_per_pixel, launch_bytes
from clpipe.stage import Kind, Stage, variant_label, variants


@dataclass(frozen=True)
class Speed:
    """The speed of a launch or of the chain.

    Attributes:
        name: of the launch, or "chain".
        ms: the time in ms.
        mp_per_s: megapixels per second.
        gb_per_s: device memory read and written, in GB/s.
        share_of_copy: ``gb_per_s`` as a fraction of the device's copy speed.
    """

    name: str
    ms: float
    mp_per_s: float
    gb_per_s: float
    share_of_copy: float


@dataclass(frozen=True)
class BenchReport:
    """The result of a benchmark: the speeds of a chain and of its launches, and the conditions."""

    device: str
    width: int
    height: int
    copy_gb_per_s: float
    bytes_per_pixel: float
    first_run_s: float
    chain: Speed
    launches: tuple[Speed, ...]

    def record(self) -> dict[str, Any]:
        """Return the report as JSON values, with the chain's ``mp_per_s`` at the top level."""
        return {"mp_per_s": self.chain.mp_per_s} | asdict(self)


@dataclass(frozen=True)
class MethodSpeed:
    """The speed of one method of a stage: number of launches, time in ms, megapixels per second."""

    method: str
    launches: int
    ms: float
    mp_per_s: float


def scene(width: int, height: int) -> Array:
    """Return a test image with gradients, texture and edges, (height, width, 3) float16."""
    x, y = np.linspace(0, 60, width, dtype=np.float32), np.linspace(0, 40, height, dtype=np.float32)
    shade = (np.sin(x)[None, :] * np.cos(y)[:, None] + 1) * 0.4
    shade[:, :: max(width // 50, 1)] *= 0.3
    texture = np.random.default_rng(0).random((height, width), np.float32) * 0.05
    colour = np.array([1.0, 0.8, 0.6], np.float32)
    return ((shade + texture)[..., None] * colour).astype(np.float16)


def benchmark_image(chain: Chain, width: int, height: int) -> Array:
    """Return a test image of the kind that a chain starts on, (height, width[, 3]).

    It is float16, or float32 for a chain that starts on a raw in DN.
    """
    picture = scene(width, height)
    if len(chain.source.channels) > 1:
        return picture
    mosaic = np.ascontiguousarray(picture[..., 1])
    if chain.source is not Kind.RAW:
        return mosaic
    black, white = chain.camera.black_level, chain.camera.white_level
    return np.rint(black + mosaic.astype(np.float32) * (white - black))


def bench(
    device: Device, chain: Chain, width: int = 6000, height: int = 4000, repeat: int = 7
) -> BenchReport:
    """Time a chain on the device, from its input (see :func:`benchmark_image`) to eight-bit RGB.

    The time of the chain includes one wait at its end. Launches that run in bands are timed apart
    from the chain, each over the whole image, by the device's events. Each figure is the best of
    ``repeat`` runs after a first run, which compiles.
    """
    runner, apart = Runner(chain, device), Runner(chain, device, bands=False)
    image = benchmark_image(chain, width, height)
    pixels = width * height
    start = time.perf_counter()
    runner.run(image, "bench")
    first_run = time.perf_counter() - start
    chain_seconds = float("inf")
    best: list[Timing] = []
    apart.run(image, "bench")
    for _ in range(repeat):
        start = time.perf_counter()
        runner.run(image, "bench", RunOptions(download=False))
        chain_seconds = min(chain_seconds, time.perf_counter() - start)
        timings: list[Timing] = []
        apart.run(image, "bench", RunOptions(timings, download=False))
        timings = [t for t in timings if not t.transfer]
        best = [
            min(a, b, key=lambda t: t.seconds)
            for a, b in zip(timings, best or timings, strict=True)
        ]
    copy_bytes_per_s = device.copy_speed()
    plan, launches = runner.plan_for(image), apart.plan_for(image).launches

    def speed(name: str, seconds: float, traffic: float) -> Speed:
        seconds = max(seconds, 1e-9)
        return Speed(
            name,
            seconds * 1e3,
            pixels / seconds / 1e6,
            traffic / seconds / 1e9,
            traffic / seconds / copy_bytes_per_s,
        )

    lanes = device.info.lanes
    chain_bytes = sum(launch_bytes(plan, launch, lanes) for launch in plan.launches)
    traffic = [launch_bytes(plan, launch, lanes) * pixels for launch in launches]
    return BenchReport(
        device=device.info.label,
        width=width,
        height=height,
        copy_gb_per_s=copy_bytes_per_s / 1e9,
        bytes_per_pixel=bytes_per_pixel(plan, lanes),
        first_run_s=first_run,
        chain=speed("chain", chain_seconds, chain_bytes * pixels),
        launches=tuple(speed(t.name, t.seconds, b) for t, b in zip(best, traffic, strict=True)),
    )


def bench_methods(
    device: Device,
    stage: Stage,
    settings: Settings,
    width: int = 6000,
    height: int = 4000,
    repeat: int = 7,
) -> list[MethodSpeed]:
    """Time every method of a stage separately, from float planes to float planes on the device.

    A figure is the sum of the best times of a method's launches. A first launch that only converts
    the source to planes is not counted, because the stage before does that in a chain. The
    settings' parameters of the stage apply to every method that has them. If the settings name a
    method, only this method is timed. Otherwise, methods that do not fit the camera are skipped.
    """
    picture = scene(width, height).astype(np.float32)
    image = picture if len(stage.reads.channels) == 3 else np.ascontiguousarray(picture[..., 1])
    settings = settings.drawn("")
    stage_parameters = settings.parameters.get(stage.name, {})
    speeds = []
    methods = [m for m in stage.methods if stage_parameters.get("method", m.method) == m.method]
    for method, variant in ((m, variant) for m in methods for variant in variants(m)):
        method_parameters = {
            name: value for name, value in stage_parameters.items() if name in method.model_fields
        }
        parameters = {"method": method.method, **method.example, **method_parameters, **variant}
        single_stage = replace(
            settings, stages=(stage.name,), skip=(), parameters={stage.name: parameters}
        )
        try:
            chain = make_chain(single_stage, stage.reads)
        except RequestError:
            if "method" in stage_parameters:
                raise
            continue  # the method is for other sensors
        runner = Runner(chain, device, encode=False, final=True)
        runner.run(image, "bench")
        best: list[float] = []
        for _ in range(repeat):
            timings: list[Timing] = []
            runner.run(image, "bench", RunOptions(timings, download=False))
            seconds = [t.seconds for t in timings if not t.transfer]
            best = [min(pair) for pair in zip(seconds, best or seconds, strict=True)]
        first = runner.plan(half=False).launches[0]
        if len(best) > 1 and isinstance(first, Launch) and not first.reads:
            del best[0]
        ms = max(sum(best), 1e-9) * 1e3
        label = variant_label(method, method_parameters | variant)
        speeds.append(MethodSpeed(label, len(best), ms, width * height / ms / 1e3))
    return speeds
