"""Every kernel against its NumPy reference, on a device."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from clpipe.base.types import Array
from clpipe.chain.chain import Chain
from clpipe.chain.making import make_chain
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import Settings
from clpipe.engine.device import Device
from clpipe.engine.options import DEFAULTS
from clpipe.engine.runner import Runner, submit_together
from clpipe.reference.cfa import PATTERNS, Pattern
from clpipe.stage import PERIOD, Kind, Method, Stage, variant_label, variants

# Odd sizes, one pixel wide and high, smaller than the widest border, more than one work-group.
SIZES = ((1, 1), (1, 9), (11, 1), (2, 3), (6, 5), (37, 53), (9, 530))
ISO = 3200  # at which every stage has something to do


@dataclass(frozen=True)
class Difference:
    """Two results compared: how many samples, how many differ at all, and by how much at most."""

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
    """How one method of a stage did, over so many cases (images)."""

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
        """The check as JSON values."""
        return {
            "stage": self.stage,
            "method": self.method,
            "cases": self.cases,
            **asdict(self.difference),
            "tolerance": self.tolerance,
            "passed": self.passed,
        }


def example(kind: Kind, size: tuple[int, int], half: bool = False, seed: int = 0) -> Array:
    """A random image of a kind, (height, width[, channel]): shadows, highlights, below black.

    Signals go from -0.05, which a 14-bit ADC clips at 0 DN, to 1.35.
    """
    random = np.random.default_rng(seed)
    if kind is Kind.RAW:
        return random.integers(0, 16384, size).astype(np.float32)
    shape = size if len(kind.channels) == 1 else (*size, len(kind.channels))
    values = random.random(shape) ** 2 * 1.4 - 0.05
    return values.astype(np.float16 if half else np.float32)


def difference(one: Array | None, two: Array | None) -> Difference:
    """Two images compared. NaN is infinitely far from anything.

    Raises:
        ValueError: one is missing, or they differ in shape.
    """
    if one is None or two is None or one.shape != two.shape:
        shapes = [None if image is None else image.shape for image in (one, two)]
        raise ValueError(f"the images have the shapes {shapes}, but both must have one shape")
    apart = np.nan_to_num(np.abs(one.astype(np.float64) - two), nan=np.inf)
    return Difference(apart.size, int(np.count_nonzero(apart)), float(apart.max()))


def compare(
    device: Device, chain: Chain, sizes: Sequence[tuple[int, int]] = SIZES, half: bool = False
) -> Difference:
    """A chain on the device and in NumPy, in float, over images of these sizes (height, width)."""
    on_device, in_numpy = (Runner(chain, d, encode=False, final=True) for d in (device, None))
    total = Difference()
    for seed, size in enumerate(sizes):
        image = example(chain.source, size, half, seed)
        one, two = (runner.run(image, "check").final for runner in (on_device, in_numpy))
        total += difference(one, two)
    return total


# Filter arrays that are no Bayer patterns: of odd and even periods, with and without clear pixels.
ARRAYS = ("x-trans", "RGBW", "RCCB", "RGB/GBR/BRG")


def laid(pattern: str) -> dict[str, str]:
    """The parameters of the stage mosaic that lay a Bayer pattern, or another array."""
    return {"pattern": pattern} if pattern in PATTERNS else {"method": "array", "array": pattern}


def chain_for(stage: Stage, method: type[Method], values: Mapping[str, Any], pattern: str) -> Chain:
    """One method of a stage as a chain that starts on what it reads, in that pattern or array."""
    if method.only_arrays and pattern not in method.only_arrays:
        pattern = method.only_arrays[0]
    before = {Kind.MOSAIC: ("mosaic",), Kind.RAW: ("mosaic", "quantize")}.get(stage.reads, ())
    parameters: dict[str, dict[str, Any]] = {"mosaic": dict(laid(pattern))}
    own = {"method": method.method, **method.example, **values}
    others = parameters.get(stage.name, {})
    parameters[stage.name] = {k: v for k, v in others.items() if k in method.model_fields} | own
    settings = Settings(iso=ISO, stages=(*before, stage.name), parameters=parameters)
    return make_chain(settings, start_at=stage.name)


def depends_on_pattern(stage: Stage, method: type[Method], values: Mapping[str, Any]) -> bool:
    """Whether the kernels of a method are compiled for a CFA pattern."""
    step = chain_for(stage, method, values, PATTERNS[0]).steps[0]
    return any("pattern" in pass_.all_arguments for pass_ in step.passes)


def arrays_of(stage: Stage, method: type[Method], values: Mapping[str, Any]) -> tuple[str, ...]:
    """The filter arrays on which a method is checked beside Bayer patterns: where it tells them."""
    if values or not method.any_array or stage.reads is not Kind.MOSAIC or method.only_arrays:
        return ()
    step = chain_for(stage, method, values, ARRAYS[0]).steps[0]
    tells = any(set(PERIOD) <= {*pass_.all_arguments} for pass_ in step.passes)
    return ARRAYS if tells else ()


def check_method(
    device: Device,
    stage: Stage,
    method: type[Method],
    sizes: Sequence[tuple[int, int]] = SIZES,
    patterns: Sequence[Pattern] | None = None,
    values: Mapping[str, Any] | None = None,
) -> Check:
    """One method of a stage, in these patterns (None is all) if it depends on the pattern; one that
    takes any filter array in :data:`ARRAYS`, too.

    ``values`` are parameters that choose a variant of the method; a variant is checked in the first
    of the patterns.
    """
    values, patterns = values or {}, patterns or PATTERNS
    # A variant reads the pattern through the same functions as the method's default.
    if values or not depends_on_pattern(stage, method, values):
        patterns = patterns[:1]
    total, every = Difference(), (*patterns, *arrays_of(stage, method, values))
    every = method.only_arrays or every
    for pattern in every:
        total += compare(device, chain_for(stage, method, values, pattern), sizes)
    label = variant_label(method, values)
    return Check(stage.name, label, len(every) * len(sizes), total, method.tolerance)


# Every source of noise at work.
NOISE: Mapping[str, Mapping[str, Any]] = {
    "prnu": {"sigma": 0.01},
    "defect_pixels": {"hot_share": 0.01, "hot_level": 0.1, "dead_share": 0.01},
    "dsnu": {"sigma": 0.001},
    "row_noise": {"sigma": 0.003},
    "column_noise": {"sigma": 0.002},
}


def check_raw(
    device: Device,
    noise: str,
    sizes: Sequence[tuple[int, int]] = SIZES,
    patterns: Sequence[Pattern] | None = None,
) -> Check:
    """The whole way from half RGB to the raw: after quantize, device and NumPy must be equal.

    ``noise`` is the method of sensor_noise.
    """
    names, patterns = list(all_stages()), patterns or PATTERNS
    stages = tuple(names[: names.index("quantize") + 1])
    total = Difference()
    for pattern in patterns:
        own: dict[str, dict[str, Any]] = {"mosaic": {"pattern": pattern}}
        own["sensor_noise"] = {"method": noise}
        settings = Settings(iso=ISO, stages=stages, parameters={**NOISE, **own})
        total += compare(device, make_chain(settings), sizes, half=True)
    cases = len(patterns) * len(sizes)
    return Check("exposure..quantize", f"the raw, {noise}", cases, total, 0.0)


def check_ends(device: Device, sizes: Sequence[tuple[int, int]] = SIZES) -> Check:
    """How images enter and leave: as half and float, RGB and mosaic; as eight bits.

    Eight bits come by conversion, or by a table where the chain ends in curves. A difference of
    one level is allowed, since an ulp before rounding can make it. No difference is allowed between
    eight bits that are the only result and those that are made beside the float image.
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
            both, alone = Runner(chain, device, final=True), Runner(chain, device)
            in_numpy = Runner(chain, None, final=True)
            for seed, size in enumerate(sizes):
                image = example(chain.source, size, half, seed)
                one, two = alone.run(image, "check"), in_numpy.run(image, "check")
                levels = difference(one.encoded, two.encoded)
                wrong = levels.largest if levels.largest > 1 else 0.0
                total += Difference(levels.samples, 0, wrong)
                if half:  # what is stored and encoded does not depend on the source
                    beside = both.run(image, "check")
                    total += difference(beside.encoded, one.encoded)
                    total += difference(beside.final, two.final)
                cases += 1
    return Check("source..8 bit", "half, float", cases, total, 0.0)


def check_stack(device: Device, sizes: Sequence[tuple[int, int]] = SIZES) -> Check:
    """The default chain over images of several sizes and ISOs in common launches, which must give
    the bits that each has alone.
    """
    total, images, alone = Difference(), [], []
    for seed, size in enumerate(sizes):
        chain = make_chain(Settings(iso=ISO + 100 * seed, parameters=NOISE))
        image = example(chain.source, size, half=True, seed=seed)
        runner = Runner(chain, device, final=True)
        alone.append(runner.run(image, "check").final)
        images.append((runner, image, "check", DEFAULTS))
    for wait, expected in zip(submit_together(images), alone, strict=True):
        total += difference(wait().final, expected)
    return Check("exposure..gamma", "common launches", len(sizes), total, 0.0)


def check_all(
    device: Device, stages: Sequence[Stage] = (), sizes: Sequence[tuple[int, int]] = SIZES
) -> Iterator[Check]:
    """Every method of these stages, in all its variants.

    If no stages are named: of all stages, then the raw, how images enter and leave, and stacks.
    """
    for stage in stages or all_stages().values():
        for method in stage.methods:
            for values in variants(method):
                yield check_method(device, stage, method, sizes, values=values)
    if not stages:
        for noise in all_stages()["sensor_noise"].by_name:
            yield check_raw(device, noise, sizes)
        yield check_ends(device, sizes)
        yield check_stack(device, sizes)
