"""From a launch to OpenCL source. Pure text: what runs is what this prints.

A kernel is the library, the stage files it needs (with ``#line``, so that the compiler's messages
name the right file and line) and one short function that loads, calls the stages and stores.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path

from clpipe.plan import AddUp, AnyLaunch, Find, Launch, Lines, Op, Plan, Read
from clpipe.stage import Access, Kind

LIBRARY = (
    "lanes",
    "math",
    "image",
    "cfa",
    "median",
    "colour",
    "random",
    "curve",
    "display",
    "source",
    "sums",
)
LOCAL_SIZE = 64
SHARES = 256  # work items of a reduction's first half


@dataclass(frozen=True)
class Parameter:
    """One kernel parameter: its OpenCL declaration, and what is bound to it.

    ``role`` is one of extent (width, height, pitch), source, slot, encoded, table8 (the composed
    curve), value, key, lines, found, sums, shares, count; ``step``, ``item`` and
    ``number`` tell which.
    """

    declaration: str
    role: str
    step: str = ""
    item: str = ""
    number: int = 0


@dataclass(frozen=True)
class Kernel:
    """A launch as OpenCL: its name, whole source, parameters in order and kind of index space."""

    name: str
    source: str
    parameters: tuple[Parameter, ...]
    launch: AnyLaunch


def round_up(value: int, step: int) -> int:
    """The smallest multiple of ``step`` that is not below ``value``."""
    return -(-value // step) * step


def apron_left(apron: int, lanes: int) -> int:
    """Columns before the first pixel of a plane's row: the apron, in whole blocks."""
    return round_up(apron, lanes)


@cache
def kernel_folder() -> Path:
    """Where the kernel files are: in the package, or beside it in a checkout."""
    packaged = Path(str(resources.files("clpipe") / "kernels"))
    return packaged if packaged.is_dir() else Path(__file__).resolve().parent.parent / "kernels"


def file_text(name: str, seen: set[str]) -> str:
    """A kernel file with its includes in place, each file once."""
    if name in seen:
        return ""
    seen.add(name)
    text = (kernel_folder() / name).read_text()
    own = f'#line 1 "kernels/{name}"\n'

    def include(match: re.Match[str]) -> str:
        line = text[: match.start()].count("\n") + 2
        return f'{file_text(match[1], seen)}#line {line} "kernels/{name}"\n'

    return own + re.sub(r'^#include "(.*)"\n', include, text, flags=re.MULTILINE)


class _Writer:
    """Collects the parameters and the body of one kernel."""

    def __init__(self, plan: Plan, lanes: int) -> None:
        self.plan = plan
        self.lanes = lanes
        self.parameters: dict[str, Parameter] = {}
        self.setup: list[str] = []

    def parameter(self, name: str, type_: str, role: str, **which: str | int) -> str:
        space = "" if type_.endswith("*") else " "
        self.parameters[name] = Parameter(f"{type_}{space}{name}", role, **which)  # type: ignore[arg-type]
        return name

    def slot(self, number: int, written: bool) -> str:
        const = "" if written else "const "
        type_ = f"__global {const}float *restrict"
        return self.parameter(f"slot{number}", type_, "slot", number=number)

    def planes(self, read: Read) -> list[str]:
        """Three plane parameters of an image that is read, the last repeated where it has less."""
        slots = [self.slot(n, False) for n in self.plan.slots[read.image.number]]
        return (slots + [slots[-1]] * 2)[:3]

    def arguments(self, op: Op, found: dict[str, tuple[str, int]]) -> list[str]:
        """The actual arguments of a pass after the pixel and its site."""
        pass_, types, literals = op.pass_, dict(op.types), dict(op.literals)
        texts = []
        if pass_.random:
            key = f"{op.step}_{pass_.random.value}_key"
            for half in "01":
                self.parameter(
                    key + half, "uint", "key", step=op.step, item=pass_.random.value + half
                )
            stage = self.parameter(f"{op.step}_stage", "uint", "key", step=op.step, item="stage")
            texts.append(f"(stream){{{key}0, {key}1, {stage}}}")
        for name in pass_.arguments:
            full = f"{op.step}_{name}"
            if name in literals:
                texts.append(literals[name])
            elif name in types:
                texts.append(self.parameter(full, types[name], "value", step=op.step, item=name))
            elif name in found:
                step, index = found[name]
                buffer = self.parameter(
                    f"{step}_found", "__global const float *", "found", step=step
                )
                line = f"const float {full} = {buffer}[{index}];"
                if line not in self.setup:
                    self.setup.append(line)
                texts.append(full)
            else:
                self.parameter(full, "__global const float *", "lines", step=op.step, item=name)
                texts.append(full)
        return texts


def found_by(plan: Plan, step: str) -> dict[str, tuple[str, int]]:
    """Names of the numbers that a step finds, with the step and the place in its buffer."""
    for launch in plan.launches:
        if isinstance(launch, Find) and launch.op.step == step:
            return {name: (step, i) for i, name in enumerate(launch.op.pass_.found)}
    return {}


def call(op: Op, arguments: Sequence[str]) -> str:
    """The call of a pass's function."""
    return f"{op.pass_.function}({', '.join(arguments)})"


def write_kernel(plan: Plan, launch: AnyLaunch, index: int, lanes: int) -> Kernel:
    """The OpenCL source of one launch of a plan, for a device with that many lanes."""
    writer = _Writer(plan, lanes)
    name = f"launch_{index}_" + re.sub(r"\W+", "_", launch.name)
    for dimension in ("width", "height", "pitch"):
        writer.parameter(dimension, "uint", "extent", item=dimension)
    seen: set[str] = set()
    left = apron_left(plan.apron, lanes)
    text = f"#define LANES {lanes}\n#define APRON {plan.apron}\n#define APRON_LEFT {left}\n"
    text += files_text([f"lib/{part}.h" for part in LIBRARY], seen)
    match launch:
        case Launch():
            body = _pixels(writer, launch)
            # The tap function calls the stages of its prologue, and the stencil calls it.
            text += files_text(kernels_of([op for r in launch.reads for op in r.prologue]), seen)
            text += _source_image(writer, launch)
            text += files_text(kernels_of([*launch.ops, launch.sums]), seen)
        case Lines():
            body = _lines(writer, launch)
            text += files_text(kernels_of(launch.ops), seen)
        case AddUp():
            body = _add_up(writer, launch)
        case Find():
            body = _find(writer, launch)
            text += files_text(kernels_of([launch.op]), seen)
    signature = ",\n    ".join(p.declaration for p in writer.parameters.values())
    size = 1 if isinstance(launch, Find) else LOCAL_SIZE
    setup = "".join(f"    {line}\n" for line in writer.setup)
    text += (
        f'#line 1 "{launch.name}"\n'
        f"__kernel __attribute__((reqd_work_group_size({size}, 1, 1)))\n"
        f"void {name}(\n    {signature})\n{{\n"
        f"    const extent e = {{width, height, pitch}};\n{setup}{body}}}\n"
    )
    return Kernel(name, text, tuple(writer.parameters.values()), launch)


def kernels_of(ops: Sequence[Op | None]) -> list[str]:
    """The kernel files of these passes."""
    return [f"{op.kernel}.cl" for op in ops if op]


def files_text(names: Sequence[str], seen: set[str]) -> str:
    """These kernel files, each once, one after the other."""
    return "".join(file_text(name, seen) for name in names)


def _prologue(writer: _Writer, read: Read) -> list[tuple[Op, list[str], list[str]]]:
    """Each pass redone at a tap, its arguments, and which of them are run-time values."""
    calls = []
    for op in read.prologue:
        arguments = writer.arguments(op, found_by(writer.plan, op.step))
        literals = dict(op.literals).values()
        calls.append((op, arguments, [a for a in arguments if a not in literals]))
    return calls


def _source_image(writer: _Writer, launch: Launch) -> str:
    """The type and the tap function of a stencil's ``src``, with the passes redone at each tap."""
    if not launch.stencil:
        return ""
    reads = dict(zip(launch.stencil.pass_.reads, launch.reads, strict=True))
    read = reads.get("src")
    if not read or not read.prologue:
        kind = read.image.kind if read else Kind.MOSAIC
        return (
            "typedef image src_image;\n"
            f"INLINE {kind.c_type} src_tap(src_image src, int dx, int dy) "
            f"{{ return tap_{kind.c_name}(src, dx, dy); }}\n"
        )
    fields = ""
    value = f"tap_{read.image.kind.c_name}(src.stored, dx, dy)"
    for op, arguments, values in _prologue(writer, read):
        fields += "".join(f"float {v}; " for v in values)
        value = call(op, [value, "at", *(f"src.{a}" if a in values else a for a in arguments)])
    return (
        f"typedef struct {{ image stored; {fields}}} src_image;\n"
        f"INLINE {read.prologue[-1].kind.c_type} src_tap(src_image src, int dx, int dy) {{\n"
        f"    const site at = shifted(src.stored.at, dx, dy);\n    return {value};\n}}\n"
    )


def _load(writer: _Writer, launch: Launch) -> tuple[list[str], list[str], Kind]:
    """What makes ``v0``, from the source, a stored image or the stencil; and its kind.

    The first lines come once a block (for a stencil that gives all its rows), the others once a
    row.
    """
    plan = writer.plan
    stencil = launch.stencil
    if not launch.reads:
        kind, dtype = plan.source, "half" if plan.half else "float"
        writer.parameter("src", f"__global const {dtype} *restrict ", "source")
        return [], [f"const {kind.c_type} v0 = source_{kind.c_name}_{dtype}(src, at, e);"], kind
    images = [f"image_at({', '.join(writer.planes(read))}, pitch, at)" for read in launch.reads]
    if not stencil:
        kind = launch.reads[0].image.kind
        return [], [f"const {kind.c_type} v0 = tap_{kind.c_name}({images[0]}, 0, 0);"], kind
    lines = []
    for name, read, stored in zip(stencil.pass_.reads, launch.reads, images, strict=True):
        values = [v for _, _, own in _prologue(writer, read) for v in own]
        type_ = "src_image" if name == "src" else "image"
        made = f"{{{', '.join([stored, *values])}}}" if values else stored
        lines.append(f"const {type_} {name} = {made};")
    arguments = writer.arguments(stencil, found_by(plan, stencil.step))
    given = ["at", *stencil.pass_.reads, *arguments]
    kind = stencil.kind
    if stencil.pass_.block:
        lines = ["const site at = site_at(x, y);", *lines, f"{call(stencil, [*given, 'block'])};"]
        size = f"{launch.rows} * {launch.columns}"
        once = [f"{kind.c_type} block[{size}];", "{", *(f"    {x}" for x in lines), "}"]
        value = f"block[row * {launch.columns} + column]" if launch.columns > 1 else "block[row]"
        return once, [f"const {kind.c_type} v0 = {value};"], kind
    return [], [*lines, f"const {kind.c_type} v0 = {call(stencil, given)};"], kind


def _encode(writer: _Writer, value: str, kind: Kind, curves: Sequence[Op]) -> str:
    """The line that writes eight-bit pixels, through one table where curves come last."""
    writer.parameter("dst", "__global uchar *restrict ", "encoded")
    if not curves:
        return f"encode_{'mosaic' if kind.c_type == 'vf' else 'rgb'}({value}, dst, at, e);"
    steps = ",".join(op.step for op in curves)
    writer.parameter("table8", "__global const uchar *restrict ", "table8", item=steps)
    return f"encode_rgb_by_table({value}, table8, dst, at, e);"


def _pixels(writer: _Writer, launch: Launch) -> str:
    """The body of a kernel over the image: load, the stages, store."""
    plan = writer.plan
    once, lines, kind = _load(writer, launch)
    ops = list(launch.ops[1:] if launch.stencil else launch.ops)
    curves: list[Op] = []
    while launch.encodes and not launch.writes and ops and ops[-1].pass_.access is Access.CURVE:
        curves.insert(0, ops.pop())
    for i, op in enumerate(ops):
        kind = op.kind
        made = call(op, [f"v{i}", "at", *writer.arguments(op, found_by(plan, op.step))])
        lines.append(f"const {kind.c_type} v{i + 1} = {made};")
    value = f"v{len(ops)}"
    before, after = "".join(f"    {line}\n" for line in once), ""
    if launch.sums:
        writer.parameter("sums", "__global int4 *restrict ", "sums")
        lines.append(f"const vi sample = only_inside({call(launch.sums, [value])}, at, e);")
        lines.append("if (row & 1) odd_rows += sample; else even_rows += sample;")
        before += "    vi even_rows = (vi)(0), odd_rows = (vi)(0);\n"
        after = (
            "    const site first = site_at(x, y);\n"
            "    const size_t block = get_global_id(1) * ((width + LANES - 1) / LANES) + "
            "get_global_id(0);\n"
            "    sums[block] = (int4)(fold_columns(even_rows, first), "
            "fold_columns(odd_rows, first));\n"
        )
    if launch.writes:
        slots = [writer.slot(n, True) for n in plan.slots[launch.writes.number]]
        lines.append(f"store_{kind.c_name}({', '.join([value, *slots])}, at, e);")
    if launch.encodes:
        lines.append(_encode(writer, value, kind, curves))
    across, column_x, unroll = "LANES", "x", ""
    if launch.columns > 1:
        across, column_x = f"LANES * {launch.columns}", "x + column * LANES"
        unroll = " 1"  # what is stored is in an array already: more copies only compile longer
    lines.insert(0, f"const site at = site_at({column_x}, y + row);")
    if launch.columns > 1:
        head = (
            f"for (uint column = 0; column < {launch.columns} && {column_x} < width; ++column) {{"
        )
        lines = [head, *(f"    {line}" for line in lines), "}"]
    rows = "".join(f"        {line}\n" for line in lines)
    return (
        f"    const uint x = (uint)get_global_id(0) * {across};\n"
        f"    const uint y = (uint)get_global_id(1) * {launch.rows};\n"
        f"    if (x >= width) return;\n{before}"
        f"#pragma unroll{unroll}\n    for (uint row = 0; row < {launch.rows}; ++row) {{\n"
        f"{rows}    }}\n{after}"
    )


def _lines(writer: _Writer, launch: Lines) -> str:
    body = "    const uint i = (uint)get_global_id(0) * LANES;\n"
    body += "    const vu line = lane_indices(i);\n"
    for op in launch.ops:
        table = writer.parameter(
            f"{op.step}_{op.pass_.writes}",
            "__global float *",
            "lines",
            step=op.step,
            item=op.pass_.writes,
        )
        count = "height" if op.pass_.lines == "rows" else "width"
        value = call(op, ["line", *writer.arguments(op, {})])
        body += f"    if (i < {count}) store({value}, {table} + i);\n"
    return body


def _add_up(writer: _Writer, launch: AddUp) -> str:
    writer.parameter("sums", "__global const int4 *", "sums")
    writer.parameter("shares", "__global long4 *", "shares")
    writer.parameter("count", "uint", "count", step=launch.op.step)
    return "    add_up_blocks(sums, shares, count);\n"


def _find(writer: _Writer, launch: Find) -> str:
    writer.parameter("shares", "__global const long4 *", "shares")
    found = writer.parameter(
        f"{launch.op.step}_found", "__global float *", "found", step=launch.op.step
    )
    arguments = writer.arguments(launch.op, {})
    finish = launch.op.pass_.finish
    texts = [f"add_up_shares(shares, {SHARES})", *arguments, "e", found]
    return f"    {finish}({', '.join(texts)});\n"
