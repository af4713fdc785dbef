"""The parameters of a kernel, collected while its text is written, under canonical names."""

from collections.abc import Sequence
from dataclasses import dataclass

from clpipe.engine.ops import Op
from clpipe.engine.plan import Finalize, Plan, Read
from clpipe.stage import NoiseScope

LARGER = (
    "{from_width, from_height, from_pitch, from_left * LANES, from_top * 4, from_columns, "
    "from_rows, border}"
)


@dataclass(frozen=True)
class Parameter:
    """One kernel parameter: its OpenCL declaration, and what is bound to it.

    ``role`` is one of tile (a number of :class:`clpipe.engine.extents.Extent`, or the tile's own
    number), source, slot, encoded, table8 (the composed curve), value, key, lines, estimates, sums,
    partials, counts, histogram, taps (of the resampling that leads on from the level ``number``).
    ``step``, ``item`` and ``number`` say which one of that role; they are not part of the text.
    """

    declaration: str
    role: str
    step: str = ""
    item: str = ""
    number: int = 0


class Writer:
    """Collects the parameters and the body of one kernel, and gives canonical names to both."""

    def __init__(self, plan: Plan, lanes: int) -> None:
        self.plan = plan
        self.lanes = lanes
        self.parameters: dict[str, Parameter] = {}
        self.setup: list[str] = []
        self._steps: list[str] = []
        self._slots: list[int] = []

    def name(self, step: str, item: str) -> str:
        """The name in the text of something that belongs to a step, such as ``step0_gain``."""
        if step not in self._steps:
            self._steps.append(step)
        return f"step{self._steps.index(step)}_{item}"

    def parameter(self, name: str, type_: str, role: str, **which: str | int) -> str:
        """A parameter of the kernel; the fields of :class:`Parameter` say what is bound to it."""
        space = "" if type_.endswith("*") else " "
        self.parameters[name] = Parameter(f"{type_}{space}{name}", role, **which)  # type: ignore[arg-type]
        return name

    def tile(self, number: str) -> str:
        """The parameter of a number of the tile, or of the larger image that it is made from."""
        return self.parameter(number, "uint", "tile", item=number)

    def core(self) -> str:
        """The tile's core."""
        sides = [self.tile(f"core_{side}") for side in ("left", "top", "right", "bottom")]
        self.setup.append(f"const core c = {{{', '.join(sides)}}};")
        return "c"

    def larger(self) -> str:
        """The extent of the image that a resampling reads."""
        for number in ("width", "height", "pitch", "left", "top", "columns", "rows"):
            self.tile(f"from_{number}")
        self.setup.append(f"const extent from = {LARGER};")
        return "from"

    def taps(self, level: int) -> list[str]:
        """The parameters of the resampling that leads on from a level."""
        return [
            self.parameter(f"tap_{item}", type_, "taps", item=item, number=level)
            for item, type_ in self.plan.resamplings[level].parameters
        ]

    def slot(self, number: int, written: bool) -> str:
        """The parameter of a plane."""
        if number not in self._slots:
            self._slots.append(number)
        const = "" if written else "const "
        type_ = f"__global {const}float *restrict"
        name = f"plane{self._slots.index(number)}"
        return self.parameter(name, type_, "slot", number=number)

    def planes(self, read: Read) -> list[str]:
        """Three plane parameters of an image that is read, the last repeated where it has less."""
        slots = [self.slot(n, False) for n in self.plan.slots[read.image.number]]
        return (slots + [slots[-1]] * 2)[:3]

    def lines(self, step: str, item: str, written: bool) -> str:
        """The parameter of a step's line table."""
        type_ = "__global float *" if written else "__global const float *"
        return self.parameter(self.name(step, item), type_, "lines", step=step, item=item)

    def estimates(self, step: str, written: bool) -> str:
        """The parameter of the buffer with the numbers that a step estimates from the image."""
        type_ = "__global float *" if written else "__global const float *"
        return self.parameter(self.name(step, "estimates"), type_, "estimates", step=step)

    def stream(self, op: Op, scope: NoiseScope) -> str:
        """The random stream of a pass, from three parameters."""

        def word(item: str, name: str) -> str:
            return self.parameter(self.name(op.step, name), "uint", "key", step=op.step, item=item)

        keys = [word(f"{scope.value}{half}", f"{scope.value}_key{half}") for half in "01"]
        return f"(stream){{{', '.join([*keys, word('stage', 'stage')])}}}"

    def arguments(self, op: Op, names: Sequence[str] | None = None) -> list[str]:
        """The actual arguments of a pass, or those ``names``, after the pixel and its site."""
        pass_, types, literals = op.pass_, dict(op.types), dict(op.literals)
        estimates = estimates_of(self.plan, op.step)
        texts = [self.stream(op, pass_.random)] if pass_.random else []
        for item in pass_.arguments if names is None else names:
            if item in literals:
                texts.append(literals[item])
            elif item in types:
                name = self.name(op.step, item)
                texts.append(self.parameter(name, types[item], "value", step=op.step, item=item))
            elif item in estimates:
                name, buffer = self.name(op.step, item), self.estimates(op.step, written=False)
                line = f"const float {name} = {buffer}[{estimates.index(item)}];"
                if line not in self.setup:
                    self.setup.append(line)
                texts.append(name)
            else:
                texts.append(self.lines(op.step, item, written=False))
        return texts


def estimates_of(plan: Plan, step: str) -> tuple[str, ...]:
    """The names of the numbers that a step estimates from the image, in their buffer's order."""
    for launch in plan.launches:
        if isinstance(launch, Finalize) and launch.op.step == step:
            return launch.op.pass_.estimates
    return ()
