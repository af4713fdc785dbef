"""Random chains of random passes: their plans produce the results of their passes.

The tests execute a plan with symbols for images. Each slot holds the symbol that was last written.
A wrong plan gives another symbol in a result: a slot reused too early, a read before the write, or
a pass that is skipped, repeated or moved. Some of the chains also run on the device.
"""

from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import ClassVar

import numpy as np
import pytest
from pydantic import PrivateAttr

from clpipe.camera.profile import DEFAULT_CAMERA, load_camera
from clpipe.chain.chain import Chain, Step
from clpipe.chain.registry import all_stages
from clpipe.chain.settings import Settings
from clpipe.engine.check import example
from clpipe.engine.ir import Cpu, Finalize, Histogram, Launch, Lines, Plan, Reduce, reads_of
from clpipe.engine.ops import Op
from clpipe.engine.plan import make_plan
from clpipe.engine.runner import Runner
from clpipe.stage import (
    CompileTime,
    Context,
    Kind,
    LineTable,
    Method,
    Pass,
    Pointwise,
    Reduction,
    Resample,
    Stage,
    Stencil,
)

FOLDER = Path(__file__).parent / "data"
BY = np.float32(0.125)
MIXED = "source"  # stages that read it again after other passes


def stencils(reach: int) -> dict[str, tuple[Pass, ...]]:
    """Stages with stencils, by what they do."""
    added_up = Pass("added_up", writes="one", kind=Kind.MOSAIC)
    mixed = Pass("mixed", Stencil(reach), ("reach",), ("src", "one"))
    sloped = Pass("slope", Stencil(reach), ("reach",), ("one",), "two", Kind.MOSAIC)
    return {
        "around": (Pass("around", Stencil(reach), ("reach",)),),
        "around and halved": (
            Pass("around", Stencil(reach), ("reach",), writes="one"),
            Pass("halved", reads=("one",)),
        ),
        "one plane": (added_up, sloped, Pass("spread_out", reads=("two",))),
        f"{MIXED} again": (added_up, mixed),
        f"{MIXED} after two": (
            added_up,
            sloped,
            Pass("mixed", Stencil(reach), ("reach",), ("src", "two")),
        ),
    }


def pointwise(is_inlined: bool) -> dict[str, tuple[Pass, ...]]:
    """Stages of single pixels, by what they do."""
    inlined = Pointwise(inline_at_taps=is_inlined)
    return {
        "raised": (Pass("raised", inlined, ("by",)),),
        "doubled": (
            Pass("raised", inlined, ("by",), writes="one"),
            Pass("doubled", reads=("one",)),
        ),
        "halved first": (
            Pass("halved", Pointwise(inverse_of="doubled"), writes="one"),
            Pass("raised", inlined, ("by",), ("one",)),
        ),
        "lines": (
            Pass("offsets", LineTable("rows"), ("by",), writes="lines"),
            Pass("with_offsets", arguments=("lines",)),
        ),
        "gain": (
            Pass("is_bright", Reduction("gain_of", ("gain",))),
            Pass("scaled", inlined, ("gain",)),
        ),
        "nothing": (),
    }


def mirrored(image: np.ndarray, dx: int, dy: int) -> np.ndarray:
    """Shift an image, mirrored at its borders."""
    reach = max(abs(dx), abs(dy))
    wide = np.pad(image, ((reach, reach), (reach, reach), (0, 0))[: image.ndim], "reflect")
    height, width = image.shape[:2]
    return wide[reach + dy : reach + dy + height, reach + dx : reach + dx + width]


def around(src: np.ndarray, reach: int) -> np.ndarray:
    """The kernel function of that name in NumPy."""
    across = mirrored(src, -reach, 0) + mirrored(src, reach, 0)
    return (across + (mirrored(src, 0, -reach) + mirrored(src, 0, reach))) * np.float32(0.25)


def colours(*values: np.ndarray) -> np.ndarray:
    """Three planes as one image."""
    return np.stack(values, axis=-1)


HALF, QUARTER = np.float32(0.5), np.float32(0.25)
SIGNS = np.float32([1, 1, -1])
FUNCTIONS: dict[str, Callable[..., np.ndarray]] = {
    "doubled": lambda c: c * np.float32(2),
    "halved": lambda c: c * HALF,
    "raised": lambda c, by: colours(c[..., 0] + by, c[..., 1] - by, c[..., 2] + by * HALF),
    "added_up": lambda c: (c[..., 0] + c[..., 1]) + c[..., 2],
    "spread_out": lambda y: colours(y, y * HALF, y * QUARTER),
    "around": around,
    "slope": lambda y, reach: mirrored(y, reach, reach) - mirrored(y, -reach, 0) * HALF,
    "mixed": lambda c, y, reach: (
        c + mirrored(y, reach, -reach)[..., None] * np.float32([-1, 0.5, 0.25])
    ),
    "with_offsets": lambda c, lines: c + lines[: len(c), None, None] * SIGNS,
    "scaled": lambda c, gain: c * gain,
}


class Composed(Method):
    """Passes out of the functions above."""

    method: ClassVar = "random"
    kernel: ClassVar = "random_passes"
    summary: ClassVar = "passes of a test"

    _passes: tuple[Pass, ...] = PrivateAttr(())
    _reach: int = PrivateAttr(1)

    def passes(self):
        return self._passes

    def arguments(self, context):
        return {"by": BY, "reach": CompileTime(str(self._reach))}

    def reference(self, image, given):
        known = {"src": image, "by": BY, "reach": self._reach}
        for each in self._passes:
            match each.access:
                case LineTable():
                    known["lines"] = (np.arange(len(image)) & 3).astype(np.float32) * BY
                case Reduction():
                    bright = np.count_nonzero(known["src"][..., 1] > HALF) & 7
                    known["gain"] = HALF + np.float32(bright) * np.float32(0.125)
                    given.estimates["gain"] = float(known["gain"])
                case _:
                    names = (*each.reads, *each.arguments)
                    known[each.writes] = FUNCTIONS[each.function](*(known[n] for n in names))
        return known.get("dst", image)


class WithTaps(Composed):
    """Passes of which one taps the image that the stage reads."""

    kernel: ClassVar = "random_stencils"


def random_chain(random: Random, for_device: bool = False) -> Chain:
    """A chain of one to eight stages, which may begin and end anyhow.

    Not ``for_device`` are those whose results differ in the last bit, or that no file has all of.
    """
    context, steps = Context(load_camera(DEFAULT_CAMERA), 100), []
    for number in range(random.randint(1, 8)):
        name = f"s{number}x"
        if random.random() < 0.1 and not for_device:
            stage = all_stages()["resize"]
            steps.append(Step(name, stage, stage.methods[0](scale=0.5), context))
            continue
        reach, stages = random.randint(1, 3), pointwise(random.random() < 0.6)
        stages |= {n: p for n, p in stencils(reach).items() if not for_device or MIXED not in n}
        chosen = random.choice(sorted(stages))
        made = WithTaps() if chosen.startswith("around") else Composed()
        method = made.with_state(_passes=stages[chosen], _reach=reach)
        stage = Stage(name, "A stage of a test.", Kind.RGB, Kind.RGB, (Composed,), folder=FOLDER)
        steps.append(Step(name, stage, method, context))
    names = tuple(step.name for step in steps)
    return Chain(tuple(steps), Kind.RGB, context.camera, Settings(), names)


class Symbols:
    """A number for each thing that can be made, the same for what is made alike."""

    def __init__(self):
        self.numbers, self.makers = {}, []

    def of(self, function, *of):
        if function == "halved" and self.makers[of[0]][0] == "doubled":
            return self.makers[of[0]][1]  # it is undone, whether anybody does so or not
        if (function, *of) not in self.numbers:
            self.numbers[function, *of] = len(self.makers)
            self.makers.append((function, *of))
        return self.numbers[function, *of]


def results_of_passes(chain: Chain, symbols: Symbols) -> dict[str, int]:
    """Return the result of each step of a chain from its passes only."""
    image, found = symbols.of("source"), {}
    for step in chain.steps:
        known = {"src": image, "dst": image}
        for each in step.method.passes():
            further = [known[name] for name in each.arguments if name in known]
            match each.access:
                case LineTable():
                    known[each.writes] = symbols.of(each.function, step.name)
                case Reduction(finish, estimates):
                    known[estimates[0]] = symbols.of(finish, symbols.of(each.function, image))
                case _:
                    reads = [known[name] for name in each.reads]
                    known[each.writes] = symbols.of(each.function, *reads, *further)
        found[step.name] = image = known["dst"]
    return found


class Execution:
    """Execute a plan with symbols."""

    def __init__(self, plan: Plan, symbols: Symbols):
        self.plan, self.symbols = plan, symbols
        self.slots: dict[int, tuple[int, int]] = {}  # the image there, and its symbol
        self.sums, self.reduced, self.given = {}, {}, {}
        self.encoded = None
        for launch in plan.launches:
            self.rings = {}  # of images between the launches of a band
            for each in (
                launch.bands.parts if isinstance(launch, Launch) and launch.bands else [launch]
            ):
                self.launch(each)

    def stored(self, image):
        if image.number in self.rings:
            return self.rings[image.number]
        held = {self.slots[slot] for slot in self.plan.slots[image.number]}
        ((number, symbol),) = held
        assert number == image.number
        return symbol

    def read(self, read):
        symbol = self.stored(read.image)
        for op in read.prologue:
            assert op.is_inlined
            symbol = self.apply(op, symbol)
        return symbol

    def apply(self, op: Op, *reads):
        names = [name for name in op.pass_.arguments if name in ("lines", "gain")]
        further = [self.given[op.step, name] for name in names]
        return self.symbols.of(op.pass_.function, *reads, *further)

    def launch(self, launch):
        match launch:
            case Lines():
                for op in launch.ops:
                    table = self.symbols.of(op.pass_.function, op.step)
                    self.given[op.step, op.pass_.writes] = table
            case Histogram():
                raise AssertionError("no stage here has one")
            case Reduce(op):
                self.reduced[op.step] = self.sums.pop(op.step)
            case Finalize(op):
                made = self.symbols.of(op.reduction.finish, self.reduced.pop(op.step))
                self.given[op.step, op.reduction.estimates[0]] = made
            case Launch():
                self.over_image(launch)

    def over_image(self, launch):
        reads = [self.read(read) for read in launch.reads] or [self.symbols.of("source")]
        ops = launch.ops
        if launch.opener:
            assert launch.stencil or len(reads) == 1
            reads, ops = [self.apply(launch.opener, *reads)], ops[1:]
        (symbol,) = reads
        for op in ops:
            symbol = self.apply(op, symbol)
        if launch.sums:
            self.sums[launch.sums.step] = self.symbols.of(launch.sums.pass_.function, symbol)
        if launch.encodes:
            self.encoded = symbol
        if launch.writes:
            read = {s for each in reads_of(launch) for s in self.plan.slots[each.image.number]}
            for slot in self.plan.slots[launch.writes.number]:
                assert slot not in read
                self.slots[slot] = launch.writes.number, symbol
            if not self.plan.slots[launch.writes.number]:
                self.rings[launch.writes.number] = symbol


@pytest.mark.parametrize("seed", range(8))
def test_what_a_plan_makes_is_what_the_passes_say(seed):
    random = Random(seed)
    for _ in range(100):
        chain, symbols = random_chain(random), Symbols()
        keep = [name for name in chain.names if random.random() < 0.25]
        encode, final = random.random() < 0.5 or not keep, random.random() < 0.5
        half, fold = (random.random() < share for share in (0.5, 0.8))
        cpu = random.choice([None, Cpu(2, 1 << 18)])
        plan = make_plan(chain, half, keep, encode, final, fold, False, cpu)
        expected, last = results_of_passes(chain, symbols), chain.names[-1]
        done = Execution(plan, symbols)
        assert not done.sums and not done.reduced
        assert {name: done.stored(image) for name, image in plan.kept} == {
            name: expected[name] for name in keep
        }
        assert done.encoded == (expected[last] if encode else None)
        if final:
            assert plan.final and done.stored(plan.final) == expected[last]
        check_sizes(plan, chain)
        used = [slot for slots in plan.slots for slot in slots]
        assert plan.slot_count == len(set(used))


def check_sizes(plan: Plan, chain: Chain) -> None:
    """Check the size of each image, and that the border covers all taps."""
    passes = [each for step in chain.steps for each in step.method.passes()]
    resamplers = [p.access.resampler for p in passes if isinstance(p.access, Resample)]
    assert list(plan.resamplings) == resamplers[: len(plan.resamplings)]
    for launch in plan.alone:
        above = [read.image.level for read in reads_of(launch)]
        is_resampled = isinstance(launch, Launch) and launch.opener and not launch.stencil
        assert all(level == launch.level - bool(is_resampled) for level in above)
        if isinstance(launch, Launch):
            assert launch.writes is None or launch.writes.level == launch.level
            assert launch.stencil is None or launch.stencil.radius <= plan.border


@pytest.mark.parametrize("seed", [14, pytest.param(4, marks=pytest.mark.slow)])
def test_random_passes_on_the_device_are_those_in_numpy(device, seed):
    chain = random_chain(Random(seed), for_device=True)
    runners = [Runner(chain, each, chain.names, encode=False) for each in (device, None)]
    alone = Runner(chain, device, encode=False, final=True)
    for size in ((9, 21), (37, 53)):
        image = example(Kind.RGB, size, half=True, seed=seed)
        one, two = (runner.run(image, "k") for runner in runners)
        assert one.estimates == two.estimates
        for name in chain.names:
            assert np.array_equal(one.kept[name], two.kept[name]), name
        assert np.array_equal(alone.run(image, "k").final, two.kept[chain.names[-1]])
