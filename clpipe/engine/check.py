"""Comparison of every kernel with its NumPy reference, on a device."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from clpipe.base.types import Array
from clpipe.chain.chain import Chain
from clpipe.chain.making import make_chain
from clpipe.chain.registry import all_stages, stage_in
from clpipe.chain.render_camera import RenderCamera
from clpipe.chain.settings import Settings
from clpipe.engine.device import Device
from clpipe.engine.options import RunOptions
from clpipe.engine.runner import Runner
from clpipe.engine.service import Frame, Service
from clpipe.engine.state import State, has_state
from clpipe.reference.cfa import PATTERNS, Pattern
from clpipe.stage import PERIOD, Kind, Method, Stage, StageRole, variant_label, variants

# Odd sizes, one pixel wide and high, smaller than the widest border, more than one work-group.
SIZES = ((1, 1), (1, 9), (11, 1), (2, 3), (6, 5), (37, 53), (9, 530))
BANDS = (420.0, 470.0, 500.0, 560.0, 610.0, 680.0, 700.0)  # nm; of a spectral render
ISO = 3200  # an ISO at which every stage has an effect


@dataclass(frozen=True)
class Difference:
    """The difference of two results: samples, differing samples, and the largest difference."""

    samples: int = 0
    differing: int = 0
    largest: float = 0.0

    def __add__(self, other: "Difference") -> "Difference":
        return Difference(
            self.samples + other.samples,
            self.differing + other.differing,
            max(self.largest, other.largest),
        )


@dataclass(frozen=True)
class Check:
    """The result of checking one method of a stage. ``cases`` is the number of images."""

    stage: str
    method: str
    cases: int
    difference: Difference
    tolerance: float

    @property
    def passed(self) -> bool:
        """Whether the largest difference is within the declared tolerance."""
        return self.difference.largest <= self.tolerance

    def record(self) -> dict[str, Any]:
        """Return the check as JSON values."""
        values = asdict(self)
        return {**values.pop("difference"), **values, "passed": self.passed}


def example(
    kind: Kind, size: tuple[int, int], half: bool = False, seed: int = 0, bands: int = 0
) -> Array:
    """Return a random image of a kind, (height, width[, channel]), or one with spectral bands.

    Its signals range from -0.05, which a 14-bit ADC clips at 0 DN, to 1.35.
    """
    random = np.random.default_rng(seed)
    if kind is Kind.RAW:
        return random.integers(0, 16384, size).astype(np.float32)
    shape = size if len(kind.channels) == 1 else (*size, bands or len(kind.channels))
    values = random.random(shape) ** 2 * 1.4 - 0.05
    return values.astype(np.float16 if half else np.float32)


def difference(first: Array | None, second: Array | None) -> Difference:
    """Return the difference of two images. NaN differs infinitely from any value.

    Raises:
        ValueError: an image is missing, or the shapes differ.
    """
    if first is None or second is None or first.shape != second.shape:
        shapes = [None if image is None else image.shape for image in (first, second)]
        raise ValueError(f"the images have the shapes {shapes}, but both must have one shape")
    differences = np.nan_to_num(np.abs(first.astype(np.float64) - second), nan=np.inf)
    return Difference(
        differences.size, int(np.count_nonzero(differences)), float(differences.max())
    )


def compare(
    device: Device, chain: Chain, sizes: Sequence[tuple[int, int]] = SIZES, half: bool = False
) -> Difference:
    """Return the difference of a chain's float results on the device and in NumPy.

    For a stage with state, each image is the second frame of a sequence, after a noisier one.

    Args:
        device: the device.
        chain: the chain.
        sizes: the (height, width) of the test images.
        half: whether the images are float16, not float32.
    """
    on_device, in_numpy = (Runner(chain, d, encode=False, final=True) for d in (device, None))
    total = Difference()
    for seed, size in enumerate(sizes):
        image = example(chain.source, size, half, seed, chain.bands)
        result, expected = (last_frame(runner, image) for runner in (on_device, in_numpy))
        total += difference(result, expected)
    return total


def last_frame(runner: Runner, image: Array) -> Array | None:
    """Return the float result of an image; with state, that of the second of two frames."""
    if not has_state(runner.chain):
        return runner.run(image, "check").final
    state = State()
    noise = np.random.default_rng(0).normal(0, 0.01, image.shape)
    runner.run((image + noise).astype(image.dtype), "check", RunOptions(state=state))
    return runner.run(image, "check", RunOptions(state=state)).final


# Filter arrays that are not Bayer patterns: odd and even periods, with and without clear pixels.
ARRAYS = ("x-trans", "RGBW", "RCCB", "RGB/GBR/BRG")


def mosaic_parameters(pattern: str) -> dict[str, str]:
    """Return the parameters of the stage mosaic for a Bayer pattern or another filter array."""
    return {"pattern": pattern} if pattern in PATTERNS else {"method": "array", "array": pattern}


def chain_for(stage: Stage, method: type[Method], values: Mapping[str, Any], pattern: str) -> Chain:
    """Return a chain of one method that starts on its input, with a pattern or filter array."""
    if method.only_arrays and pattern not in method.only_arrays:
        pattern = method.only_arrays[0]
    earlier_stages = {Kind.MOSAIC: ("mosaic",), Kind.RAW: ("mosaic", "quantize")}.get(
        stage.reads, ()
    )
    parameters: dict[str, dict[str, Any]] = {"mosaic": dict(mosaic_parameters(pattern))}
    method_parameters = {"method": method.method, **method.example, **values}
    stage_parameters = parameters.get(stage.name, {})
    parameters[stage.name] = {
        k: v for k, v in stage_parameters.items() if k in method.model_fields
    } | method_parameters
    render = RenderCamera(wavelengths=BANDS if stage.role is StageRole.SPECTRUM else ())
    stages = (*earlier_stages, stage.name)
    settings = Settings(iso=ISO, stages=stages, parameters=parameters, render=render)
    return make_chain(settings, start_at=stage.name)


def depends_on_pattern(stage: Stage, method: type[Method], values: Mapping[str, Any]) -> bool:
    """Return whether the kernels of a method are compiled for a CFA pattern."""
    step = chain_for(stage, method, values, PATTERNS[0]).steps[0]
    return any("pattern" in pass_.all_arguments for pass_ in step.passes)


def filter_arrays_for(
    stage: Stage, method: type[Method], values: Mapping[str, Any]
) -> tuple[str, ...]:
    """Return the filter arrays to check in addition to Bayer patterns, if the method uses them."""
    if values or not method.any_array or stage.reads is not Kind.MOSAIC or method.only_arrays:
        return ()
    step = chain_for(stage, method, values, ARRAYS[0]).steps[0]
    uses_array = any(set(PERIOD) <= {*pass_.all_arguments} for pass_ in step.passes)
    return ARRAYS if uses_array else ()


def check_method(
    device: Device,
    stage: Stage,
    method: type[Method],
    sizes: Sequence[tuple[int, int]] = SIZES,
    patterns: Sequence[Pattern] | None = None,
    values: Mapping[str, Any] | None = None,
) -> Check:
    """Check one method of a stage.

    A method that accepts any filter array is also checked with :data:`ARRAYS`.

    Args:
        device: the device.
        stage: the stage.
        method: the method.
        sizes: the (height, width) of the test images.
        patterns: the Bayer patterns; None is all. A method that does not depend on the pattern is
            checked with the first one only.
        values: parameters that choose a variant of the method. A variant is checked with the first
            pattern only.
    """
    values, patterns = values or {}, patterns or PATTERNS
    # A variant reads the pattern through the same functions as the method's default.
    if values or not depends_on_pattern(stage, method, values):
        patterns = patterns[:1]
    total, all_patterns = Difference(), (*patterns, *filter_arrays_for(stage, method, values))
    all_patterns = method.only_arrays or all_patterns
    for pattern in all_patterns:
        total += compare(device, chain_for(stage, method, values, pattern), sizes)
    label = variant_label(method, values)
    return Check(stage.name, label, len(all_patterns) * len(sizes), total, method.tolerance)


def sensor_parameters() -> dict[str, Mapping[str, Any]]:
    """Return parameters that enable every effect of the sensor, by stage.

    The noise of the stage with the role SENSOR_NOISE is that of camera and ISO.
    """
    found: dict[str, Mapping[str, Any]] = {}
    for stage in all_stages().values():
        if stage.is_sensor and stage.role is not StageRole.SENSOR_NOISE:
            # The default may be a method that does nothing, which has no example.
            method = next((m for m in stage.methods if m.example), stage.methods[0])
            found[stage.name] = {"method": method.method, **method.example}
    return found


def stages_to_raw() -> tuple[str, ...]:
    """Return all stages from the render to the raw. Plug-ins of the sensor come last of these."""
    names = [*all_stages()]
    raw = stage_in(StageRole.RAW).name
    chain = names[: names.index(raw)]
    others = [name for name in sensor_parameters() if name not in chain]
    return (*chain, *others, raw)


def check_raw(
    device: Device,
    noise: str,
    sizes: Sequence[tuple[int, int]] = SIZES,
    patterns: Sequence[Pattern] | None = None,
) -> Check:
    """Check all stages from half RGB to the raw: device and NumPy must be equal after quantize.

    Every effect of the sensor is enabled. ``noise`` is the method of the stage sensor_noise.
    """
    stages, patterns = stages_to_raw(), patterns or PATTERNS
    total = Difference()
    for pattern in patterns:
        parameters = sensor_parameters() | {stage_in(StageRole.PATTERN).name: {"pattern": pattern}}
        parameters[stage_in(StageRole.SENSOR_NOISE).name] = {"method": noise}
        settings = Settings(iso=ISO, stages=stages, parameters=parameters)
        total += compare(device, make_chain(settings), sizes, half=True)
    cases = len(patterns) * len(sizes)
    return Check("exposure..quantize", f"the raw, {noise}", cases, total, 0.0)


def check_formats(device: Device, sizes: Sequence[tuple[int, int]] = SIZES) -> Check:
    """Check the input and output formats: half and float, RGB and mosaic; eight-bit results.

    Eight-bit pixels result from a conversion, or from a table if the chain ends in curves. A
    difference of one level is allowed, because an ulp before rounding can cause it. The eight-bit
    pixels must be equal with and without a float image as second result.
    """
    total, cases = Difference(), 0
    mosaic = Settings(stages=("mosaic", "inverse_white_balance"))
    curves = {"tone_curve": {"method": "camera_raw"}}
    for chain in (
        make_chain(Settings(stages=("exposure",))),
        make_chain(Settings(stages=("exposure", "tone_curve", "gamma"), parameters=curves)),
        make_chain(mosaic, start_at="inverse_white_balance"),
    ):
        for half in (False, True):
            with_final, encoded_only = Runner(chain, device, final=True), Runner(chain, device)
            in_numpy = Runner(chain, None, final=True)
            for seed, size in enumerate(sizes):
                image = example(chain.source, size, half, seed)
                result, expected = encoded_only.run(image, "check"), in_numpy.run(image, "check")
                levels = difference(result.encoded, expected.encoded)
                wrong = levels.largest if levels.largest > 1 else 0.0
                total += Difference(levels.samples, 0, wrong)
                if half:  # storing and encoding do not depend on the source's type
                    both = with_final.run(image, "check")
                    total += difference(both.encoded, result.encoded)
                    total += difference(both.final, expected.final)
                cases += 1
    return Check("source..8 bit", "half, float", cases, total, 0.0)


def check_stack(device: Device, sizes: Sequence[tuple[int, int]] = SIZES) -> Check:
    """Check the default chain on images of several sizes and ISOs in common launches.

    The results must equal those of separate launches, bit for bit.
    """
    total, frames, separate = Difference(), [], []
    for seed, size in enumerate(sizes):
        chain = make_chain(Settings(iso=ISO + 100 * seed, parameters=sensor_parameters()))
        image = example(chain.source, size, half=True, seed=seed)
        separate.append(Runner(chain, device, final=True).run(image, "check").final)
        frames.append(Frame(chain, image, "check", final=True))
    for development, expected in zip(Service([device]).develop(frames), separate, strict=True):
        total += difference(development.result().final, expected)
    return Check("exposure..gamma", "common launches", len(sizes), total, 0.0)


def check_all(
    device: Device, stages: Sequence[Stage] = (), sizes: Sequence[tuple[int, int]] = SIZES
) -> Iterator[Check]:
    """Check every method of some stages, in all variants.

    Without ``stages``, check all stages, then the raw, the input and output formats, and stacks.
    """
    for stage in stages or all_stages().values():
        for method in stage.methods:
            for values in variants(method):
                yield check_method(device, stage, method, sizes, values=values)
    if not stages:
        for noise in stage_in(StageRole.SENSOR_NOISE).by_name:
            yield check_raw(device, noise, sizes)
        yield check_formats(device, sizes)
        yield check_stack(device, sizes)
