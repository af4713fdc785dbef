"""Every kernel against its NumPy reference, on a device."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from clpipe.base.types import Array
from clpipe.chain.chain import make_chain
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import Settings
from clpipe.engine.device import Device
from clpipe.engine.runner import Runner
from clpipe.reference.cfa import PATTERNS, Pattern
from clpipe.stage import Kind, Method, Stage, variant_label, variants

# Odd sizes, one pixel wide and high, smaller than the widest border, more than one work-group.
SIZES = ((1, 1), (1, 9), (11, 1), (2, 3), (6, 5), (37, 53), (9, 530))


@dataclass(frozen=True)
class Check:
    """How one method of a stage did: the largest difference, and how many pixels differ at all."""

    stage: str
    method: str
    cases: int
    samples: int
    differing: int
    largest: float
    tolerance: float

    @property
    def passed(self) -> bool:
        """Whether the largest difference is within the declared tolerance."""
        return self.largest <= self.tolerance

    def record(self) -> dict[str, Any]:
        """The check as JSON values."""
        return asdict(self) | {"passed": self.passed}


def example(kind: Kind, size: tuple[int, int], half: bool = False, seed: int = 0) -> Array:
    """A random image of a kind, (height, width[, channel]): shadows, highlights, below black."""
    random = np.random.default_rng(seed)
    if kind is Kind.RAW:
        return random.integers(0, 16384, size).astype(np.float32)
    shape = size if len(kind.channels) == 1 else (*size, len(kind.channels))
    values = random.random(shape) ** 2 * 1.4 - 0.02
    return values.astype(np.float16 if half else np.float32)


def compare(
    device: Device, settings: Settings, source: Kind, sizes: Sequence[tuple[int, int]]
) -> tuple[int, int, float]:
    """One chain on the device and in NumPy: samples, how many differ, the largest difference.

    Eight-bit results count too, where a difference of one level is taken for none: an ulp before
    rounding can make it.
    """
    chain = make_chain(settings, source)
    encode = chain.result is not Kind.RAW
    on_device = Runner(chain, device, encode=encode, final=True)
    alone = Runner(chain, device, encode=encode)
    in_numpy = Runner(chain, None, encode=encode, final=True)
    samples, differing, largest = 0, 0, 0.0
    for number, size in enumerate(sizes):
        half = number % 2 == 1 and source is not Kind.RAW
        image = example(source, size, half, seed=number)
        one, two = on_device.run(image, "check"), in_numpy.run(image, "check")
        assert one.final is not None and two.final is not None
        if one.final.shape != two.final.shape:
            raise AssertionError(f"{one.final.shape} is not {two.final.shape}")
        difference = np.abs(one.final.astype(np.float64) - two.final)
        samples += difference.size
        differing += int(np.count_nonzero(difference))
        largest = max(largest, float(np.nan_to_num(difference, nan=np.inf).max()))
        if encode:
            encoded = alone.run(image, "check").encoded
            assert encoded is not None and two.encoded is not None and one.encoded is not None
            levels = np.abs(encoded.astype(int) - two.encoded).max()
            if levels > 1 or not np.array_equal(encoded, one.encoded):
                largest = max(largest, float(levels))
    return samples, differing, largest


def check_method(
    device: Device,
    stage: Stage,
    method: type[Method],
    sizes: Sequence[tuple[int, int]] = SIZES,
    patterns: Sequence[Pattern] = PATTERNS,
    values: Mapping[str, Any] | None = None,
) -> Check:
    """One method of a stage, behind a mosaic where it reads one so that all patterns are seen.

    ``values`` are parameters of the method that are not left at their defaults.
    """
    values = values or {}
    samples, differing, largest, cases = 0, 0, 0.0, 0
    for pattern in patterns:
        chain: tuple[str, ...] = (stage.name,)
        source = stage.reads
        if source is Kind.MOSAIC and stage.name != "mosaic":
            chain, source = ("mosaic", stage.name), Kind.RGB
        parameters: dict[str, dict[str, Any]] = {"mosaic": {"pattern": pattern}}
        own = {"method": method.method, **method.example, **values}
        parameters[stage.name] = parameters.get(stage.name, {}) | own
        settings = Settings(iso=3200, stages=chain, parameters=parameters)
        more = compare(device, settings, source, sizes)
        samples, differing = samples + more[0], differing + more[1]
        largest, cases = max(largest, more[2]), cases + len(sizes)
        if not {"mosaic"} & set(chain):
            break  # no pattern in it
    return Check(
        stage.name,
        variant_label(method, values),
        cases,
        samples,
        differing,
        largest,
        method.tolerance,
    )


# Every source of noise at work.
NOISE: Mapping[str, Mapping[str, Any]] = {
    "prnu": {"sigma": 0.01},
    "defect_pixels": {"hot_share": 0.01, "hot_level": 0.1, "dead_share": 0.01},
    "dsnu": {"sigma": 0.001},
    "row_noise": {"sigma": 0.003},
    "column_noise": {"sigma": 0.002},
}


def check_raw(device: Device, noise: str, sizes: Sequence[tuple[int, int]] = SIZES) -> Check:
    """The whole way to the raw, all patterns: after quantize, device and NumPy must be equal.

    ``noise`` is the method of sensor_noise.
    """
    names = list(all_stages())
    chain = tuple(names[: names.index("quantize") + 1])
    samples, differing, largest = 0, 0, 0.0
    for pattern in PATTERNS:
        own: dict[str, dict[str, Any]] = {"mosaic": {"pattern": pattern}}
        own["sensor_noise"] = {"method": noise}
        settings = Settings(iso=3200, stages=chain, parameters={**NOISE, **own})
        more = compare(device, settings, Kind.RGB, sizes)
        samples, differing, largest = samples + more[0], differing + more[1], max(largest, more[2])
    return Check(
        "exposure..quantize",
        f"the raw, {noise}",
        len(PATTERNS) * len(sizes),
        samples,
        differing,
        largest,
        0.0,
    )


def check_all(
    device: Device, stages: Sequence[Stage] = (), sizes: Sequence[tuple[int, int]] = SIZES
) -> Iterator[Check]:
    """Every method of these stages, in all its variants; if none are named, of all, and the raw."""
    for stage in stages or all_stages().values():
        for method in stage.methods:
            for values in variants(method):
                yield check_method(device, stage, method, sizes, values=values)
    if not stages:
        for noise in all_stages()["sensor_noise"].by_name:
            yield check_raw(device, noise, sizes)
