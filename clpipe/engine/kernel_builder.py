"""The parameters of a kernel, collected while its text is written, under canonical names."""

from collections.abc import Mapping, Sequence

from clpipe.engine.bindings import (
    ArgumentValue,
    Bound,
    Buffer,
    EncodedCurves,
    ExtentNumber,
    Parameter,
    ResamplingValue,
    StreamWord,
    TileNumber,
    slot_buffer,
    step_buffer,
)
from clpipe.engine.ir import Plan, Read
from clpipe.engine.ops import Op
from clpipe.stage import NoiseScope

LARGER = (
    "{from_width, from_height, from_pitch, from_left * LANES, from_top * 4, from_columns, "
    "from_rows, border}"
)

# A kernel is over a stack of images, which the third dimension of the index space counts. It reads
# its numbers from a table with a row for each image. The table begins at the global offset, so that
# one buffer serves all launches; offsets are above 0, for which PoCL compiles kernels of their own.
TABLE = "numbers"
AS_TYPE = {"float": "as_float({})", "int": "as_int({})", "uint": "{}"}


class KernelBuilder:
    """Collects the parameters of one kernel and what is set up of them, under canonical names."""

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

    def parameter(self, name: str, type_: str, bound: Bound) -> str:
        """A parameter of the kernel, by its name in the text, and what is bound to it."""
        space = "" if type_.endswith("*") else " "
        self.parameters[name] = Parameter(f"{type_}{space}{name}", bound)
        return name

    def buffer(
        self, name: str, element: str, buffer: str, written: bool = False, restrict: bool = True
    ) -> str:
        """The parameter of a buffer, whose elements are of an OpenCL type."""
        type_ = f"__global {'' if written else 'const '}{element} *{'restrict' if restrict else ''}"
        return self.parameter(name, type_, Buffer(buffer, written))

    def number(self, name: str) -> str:
        """The parameter of a number of the tile's extent."""
        return self.parameter(name, "uint", ExtentNumber(name))

    def tile_number(self) -> str:
        """The parameter of the tile's own number."""
        return self.parameter("tile", "uint", TileNumber())

    def core(self) -> str:
        """The tile's core."""
        sides = [self.number(f"core_{side}") for side in ("left", "top", "right", "bottom")]
        self.setup.append(f"const core c = {{{', '.join(sides)}}};")
        return "c"

    def larger(self) -> str:
        """The extent of the image that a resampling reads."""
        for number in ("width", "height", "pitch", "left", "top", "columns", "rows"):
            self.parameter(f"from_{number}", "uint", ExtentNumber(number, larger=True))
        self.setup.append(f"const extent from = {LARGER};")
        return "from"

    def taps(self, level: int) -> list[str]:
        """The parameters of the resampling that leads on from a level."""
        return [
            self.parameter(f"tap_{item}", type_, ResamplingValue(level, item))
            for item, type_ in self.plan.resamplings[level].parameters
        ]

    def slot(self, number: int, written: bool) -> str:
        """The parameter of a plane."""
        if number not in self._slots:
            self._slots.append(number)
        return self.buffer(
            f"plane{self._slots.index(number)}", "float", slot_buffer(number), written
        )

    def planes(self, read: Read) -> list[str]:
        """Three plane parameters of an image that is read, the last repeated where it has less."""
        slots = [self.slot(n, False) for n in self.plan.slots[read.image.number]]
        return (slots + [slots[-1]] * 2)[:3]

    def lines(self, step: str, item: str, written: bool) -> str:
        """The parameter of one of a step's line tables."""
        buffer = step_buffer(item, step)
        return self.buffer(self.name(step, item), "float", buffer, written, restrict=False)

    def estimates(self, step: str, written: bool) -> str:
        """The parameter of the buffer with the numbers that a step estimates from the image."""
        name, buffer = self.name(step, "estimates"), step_buffer("estimates", step)
        return self.buffer(name, "float", buffer, written, restrict=False)

    def table8(self, curves: Sequence[Op]) -> str:
        """The parameter of the table of curves and the conversion to eight bits."""
        type_, steps = "__global const uchar *restrict", tuple(op.step for op in curves)
        return self.parameter("table8", type_, EncodedCurves(steps))

    def stream(self, op: Op, scope: NoiseScope) -> str:
        """The random stream of a pass, from three parameters."""

        words = {f"{scope.value}_key0": "key0", f"{scope.value}_key1": "key1", "stage": "stage"}
        names = [
            self.parameter(self.name(op.step, name), "uint", StreamWord(op.step, scope, word))
            for name, word in words.items()
        ]
        return f"(stream){{{', '.join(names)}}}"

    def arguments(self, op: Op, names: Sequence[str] | None = None) -> list[str]:
        """The actual arguments of a pass, or those ``names``, after the pixel and its site."""
        pass_, types, literals = op.pass_, dict(op.types), dict(op.literals)
        estimates = self.plan.estimates.get(op.step, ())
        texts = [self.stream(op, pass_.random)] if pass_.random else []
        for item in pass_.arguments if names is None else names:
            if item in literals:
                texts.append(literals[item])
            elif item in types:
                name = self.name(op.step, item)
                texts.append(self.parameter(name, types[item], ArgumentValue(op.step, item)))
            elif item in estimates:
                name, buffer = self.name(op.step, item), self.estimates(op.step, written=False)
                line = f"const float {name} = {buffer}[{estimates.index(item)}];"
                if line not in self.setup:
                    self.setup.append(line)
                texts.append(name)
            else:
                texts.append(self.lines(op.step, item, written=False))
        return texts


def in_order(parameters: Mapping[str, Parameter]) -> dict[str, Parameter]:
    """Parameters in the order in which a table has their numbers.

    First those of extents, then pointers, and the values of an image's chain by their types.
    """

    def group(parameter: Parameter) -> int:
        if isinstance(parameter.bound, ExtentNumber):
            return int(parameter.bound.larger)
        if element_of(parameter) or isinstance(parameter.bound, TileNumber):
            return 2
        return 3 + list(AS_TYPE).index(parameter.declaration.split()[0])

    return dict(sorted(parameters.items(), key=lambda item: group(item[1])))


def element_of(parameter: Parameter) -> str | None:
    """The OpenCL type of what a parameter points to; None where it is a number."""
    type_, star, _ = parameter.declaration.partition("*")
    return type_.split()[-1] if star else None


def opening(parameters: Mapping[str, Parameter]) -> tuple[list[str], list[str]]:
    """The parameters that a kernel is declared with, and its first lines.

    Args:
        parameters: all that it reads, by their names in the text.
    """
    declared = [f"__global const uint *restrict {TABLE}"]
    lines = [
        "const size_t member = get_global_id(2) - get_global_offset(2);",
        f"{TABLE} += get_global_offset(2) + member * {len(parameters)};",
    ]
    for place, (name, parameter) in enumerate(parameters.items()):
        number = f"{TABLE}[{place}]"
        if element_of(parameter):
            declared.append(parameter.declaration)
            lines.append(f"{name} += member * {number};")
        else:
            type_ = parameter.declaration.split()[0]
            lines.append(f"const {type_} {name} = {AS_TYPE[type_].format(number)};")
    return declared, lines
