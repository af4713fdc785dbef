"""The parameters of a kernel, collected under canonical names while its source is generated."""

from collections.abc import Callable, Mapping, Sequence

from clpipe.engine.bands import Ring
from clpipe.engine.bindings import (
    ArgumentValue,
    Binding,
    Buffer,
    EncodedCurves,
    ExtentNumber,
    Parameter,
    ResamplingValue,
    StreamWord,
    StripNumber,
    TileNumber,
    slot_buffer,
    step_buffer,
)
from clpipe.engine.ir import Image, Plan, Read
from clpipe.engine.ops import Op
from clpipe.stage import NoiseScope

INPUT_EXTENT = (
    "{from_width, from_height, from_pitch, from_left * LANES, from_top * 4, from_columns, "
    "from_rows, border, 0}"
)

# A kernel processes a stack of images. The third dimension of the index space counts the images.
# The kernel reads its numbers from a table with a row for each image. The table begins at the
# global offset, so that one buffer serves all launches. No offset is 0, because PoCL compiles a
# separate kernel for the offset 0.
TABLE = "numbers"
AS_TYPE = {"float": "as_float({})", "int": "as_int({})", "uint": "{}"}


class KernelBuilder:
    """Collects the parameters of one kernel and its setup lines, under canonical names."""

    def __init__(self, plan: Plan, lanes: int) -> None:
        self.plan = plan
        self.lanes = lanes
        self.parameters: dict[str, Parameter] = {}
        self.setup: list[str] = []
        self._steps: list[str] = []
        self._slots: list[int] = []
        self.rings: dict[int, Ring] = {}  # by the image's number

    def name(self, step: str, item: str) -> str:
        """Return the canonical name of a step's item, such as ``step0_gain``."""
        if step not in self._steps:
            self._steps.append(step)
        return f"step{self._steps.index(step)}_{item}"

    def parameter(self, name: str, type_: str, binding: Binding) -> str:
        """Add a kernel parameter and its binding, and return its name in the source."""
        space = "" if type_.endswith("*") else " "
        self.parameters[name] = Parameter(f"{type_}{space}{name}", binding)
        return name

    def buffer(
        self, name: str, element: str, buffer: str, written: bool = False, restrict: bool = True
    ) -> str:
        """Return the parameter for a buffer with elements of an OpenCL type."""
        type_ = f"__global {'' if written else 'const '}{element} *{'restrict' if restrict else ''}"
        return self.parameter(name, type_, Buffer(buffer, written))

    def number(self, name: str) -> str:
        """Return the parameter for a number of the tile's extent."""
        return self.parameter(name, "uint", ExtentNumber(name))

    def tile_number(self) -> str:
        """Return the parameter for the number of the tile."""
        return self.parameter("tile", "uint", TileNumber())

    def core(self) -> str:
        """Return the variable with the tile's core."""
        sides = [self.number(f"core_{side}") for side in ("left", "top", "right", "bottom")]
        self.setup.append(f"const core c = {{{', '.join(sides)}}};")
        return "c"

    def input_extent(self) -> str:
        """Return the variable with the extent of the image that a resampling reads."""
        for number in ("width", "height", "pitch", "left", "top", "columns", "rows"):
            self.parameter(f"from_{number}", "uint", ExtentNumber(number, of_input=True))
        self.setup.append(f"const extent from = {INPUT_EXTENT};")
        return "from"

    def resampling_arguments(self, level: int) -> list[str]:
        """Return the parameters for the resampling from a level to the next."""
        return [
            self.parameter(f"tap_{item}", type_, ResamplingValue(level, item))
            for item, type_ in self.plan.resamplings[level].parameters
        ]

    def slot(self, number: int, written: bool) -> str:
        """Return the parameter for a plane."""
        if number not in self._slots:
            self._slots.append(number)
        return self.buffer(
            f"plane{self._slots.index(number)}", "float", slot_buffer(number), written
        )

    def planes_of(self, image: Image, written: bool) -> list[str]:
        """Return the planes of an image: parameters, or variables for the planes of a ring."""
        if image.number in self.rings:
            return [f"ring{image.number}_{c}" for c in range(len(image.kind.channels))]
        return [self.slot(n, written) for n in self.plan.slots[image.number]]

    def planes(self, read: Read) -> list[str]:
        """Return three planes of an image; the last one is repeated if it has fewer."""
        planes = self.planes_of(read.image, False)
        return (planes + [planes[-1]] * 2)[:3]

    def extent(self, image: Image) -> str:
        """Return the variable with the extent of an image."""
        return f"e{image.number}" if image.number in self.rings else "e"

    def image(self, read: Read) -> Callable[[str], str]:
        """Return a function from a row of the work item's block to an expression for an image."""
        at = "ring_at" if read.image.number in self.rings else "image_at"
        image = f"{at}({', '.join(self.planes(read))}, {self.extent(read.image)}, first"
        return lambda row: f"{image}, {row})"

    def strip(self, name: str) -> str:
        """Return the parameter for the "columns" or "rows" of a strip."""
        return self.parameter(f"strip_{name}", "uint", StripNumber(name))

    def lines(self, step: str, item: str, written: bool) -> str:
        """Return the parameter for one of a step's line tables."""
        buffer = step_buffer(item, step)
        return self.buffer(self.name(step, item), "float", buffer, written, restrict=False)

    def estimates(self, step: str, written: bool) -> str:
        """Return the parameter for the buffer of the numbers that a step estimates."""
        name, buffer = self.name(step, "estimates"), step_buffer("estimates", step)
        return self.buffer(name, "float", buffer, written, restrict=False)

    def table8(self, curves: Sequence[Op]) -> str:
        """Return the parameter for the table of curves and the conversion to eight bits."""
        type_, steps = "__global const uchar *restrict", tuple(op.step for op in curves)
        return self.parameter("table8", type_, EncodedCurves(steps))

    def stream(self, op: Op, scope: NoiseScope) -> str:
        """Return an expression for the random stream of a pass, from three parameters."""

        words = {f"{scope.value}_key0": "key0", f"{scope.value}_key1": "key1", "stage": "stage"}
        names = [
            self.parameter(self.name(op.step, name), "uint", StreamWord(op.step, scope, word))
            for name, word in words.items()
        ]
        return f"(stream){{{', '.join(names)}}}"

    def arguments(self, op: Op, names: Sequence[str] | None = None) -> list[str]:
        """Return the arguments of a pass that follow the pixel and its site.

        ``names`` selects arguments; None is all arguments of the pass.
        """
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


def sort_parameters(parameters: Mapping[str, Parameter]) -> dict[str, Parameter]:
    """Return parameters in the order of the table's columns.

    The order is: extents, pointers, then the values of an image's chain by type.
    """

    def group(parameter: Parameter) -> int:
        if isinstance(parameter.binding, ExtentNumber):
            return int(parameter.binding.of_input)
        if element_type(parameter) or isinstance(parameter.binding, TileNumber | StripNumber):
            return 2
        return 3 + list(AS_TYPE).index(parameter.declaration.split()[0])

    return dict(sorted(parameters.items(), key=lambda item: group(item[1])))


def element_type(parameter: Parameter) -> str | None:
    """Return the OpenCL type of a pointer parameter's elements; None for a number."""
    type_, star, _ = parameter.declaration.partition("*")
    return type_.split()[-1] if star else None


def kernel_opening(parameters: Mapping[str, Parameter]) -> tuple[list[str], list[str]]:
    """Return the declared parameters of a kernel, and its first lines, which read the table.

    Args:
        parameters: all parameters, by their names in the source.
    """
    declared = [f"__global const uint *restrict {TABLE}"]
    lines = [
        "const size_t member = get_global_id(2) - get_global_offset(2);",
        f"{TABLE} += get_global_offset(2) + member * {len(parameters)};",
    ]
    for column, (name, parameter) in enumerate(parameters.items()):
        number = f"{TABLE}[{column}]"
        if element_type(parameter):
            declared.append(parameter.declaration)
            lines.append(f"{name} += member * {number};")
        else:
            type_ = parameter.declaration.split()[0]
            lines.append(f"const {type_} {name} = {AS_TYPE[type_].format(number)};")
    return declared, lines
