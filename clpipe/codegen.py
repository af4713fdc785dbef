"""From a launch to OpenCL source. Pure text: what runs is what this prints.

A kernel is the library, the stage files it needs (with ``#line``, so that the compiler's messages
name the right file and line) and one short function that loads, calls the stages and stores.
"""

import re
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


def call(op: Op, first: str, rest: list[str]) -> str:
    """The call of a pass's function."""
    return f"{op.pass_.function}({', '.join([first, *rest] if first else rest)})"


def write_kernel(plan: Plan, launch: AnyLaunch, index: int, lanes: int) -> Kernel:
    """The OpenCL source of one launch of a plan, for a device with that many lanes."""
    writer = _Writer(plan, lanes)
    name = f"launch_{index}_" + re.sub(r"\W+", "_", launch.name)
    for dimension in ("width", "height", "pitch"):
        writer.parameter(dimension, "uint", "extent", item=dimension)
    files = [f"lib/{part}.h" for part in LIBRARY]
    between = ""
    match launch:
        case Launch():
            after, between, body = _pixels(writer, launch)
        case Lines():
            after, body = [f"{op.kernel}.cl" for op in launch.ops], _lines(writer, launch)
        case AddUp():
            after, body = [], _add_up(writer, launch)
        case Find():
            after, body = [f"{launch.op.kernel}.cl"], _find(writer, launch)
    left = -(-plan.apron // lanes) * lanes
    defines = f"#define LANES {lanes}\n#define APRON {plan.apron}\n#define APRON_LEFT {left}\n"
    seen: set[str] = set()
    before_files = [f for f in after if f.startswith("<")]
    text = defines + "".join(file_text(f, seen) for f in files)
    text += "".join(file_text(f[1:], seen) for f in before_files) + between
    text += "".join(file_text(f, seen) for f in after if not f.startswith("<"))
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


def _source_image(writer: _Writer, launch: Launch) -> str:
    """The type and tap function of a stencil's ``src``, with the passes redone at each tap."""
    stencil = launch.stencil
    if not stencil:
        return ""
    reads = dict(zip(stencil.pass_.reads, launch.reads, strict=True))
    read = reads.get("src")
    if not read or not read.prologue:
        kind = read.image.kind if read else Kind.MOSAIC
        return (
            "typedef image src_image;\n"
            f"INLINE {kind.c_type} src_tap(src_image src, int dx, int dy) "
            f"{{ return tap_{kind.c_name}(src, dx, dy); }}\n"
        )
    fields, calls = [], []
    value = f"tap_{read.image.kind.c_name}(src.stored, dx, dy)"
    for op in read.prologue:
        arguments = writer.arguments(op, found_by(writer.plan, op.step))
        literals = dict(op.literals).values()
        own = [a for a in arguments if a not in literals]
        fields += [f"float {a}; " for a in own]
        value = call(op, value, ["at", *(f"src.{a}" if a in own else a for a in arguments)])
        calls += own
    last = read.prologue[-1].kind
    return (
        f"typedef struct {{ image stored; {''.join(fields)}}} src_image;\n"
        f"INLINE {last.c_type} src_tap(src_image src, int dx, int dy) {{\n"
        f"    const site at = shifted(src.stored.at, dx, dy);\n    return {value};\n}}\n"
    )


def _pixels(writer: _Writer, launch: Launch) -> tuple[list[str], str, str]:
    """Stage files, what goes between those of the prologue and the others, and the body."""
    plan = writer.plan
    prologue = [op for read in launch.reads for op in read.prologue]
    files = [f"<{op.kernel}.cl" for op in prologue]
    lines: list[str] = []
    ops = list(launch.ops)
    curves: list[Op] = []
    if launch.encodes and not launch.writes:
        while ops and ops[-1].pass_.access is Access.CURVE:
            curves.insert(0, ops.pop())
    files += [f"{op.kernel}.cl" for op in ops]
    if launch.sums:
        files.append(f"{launch.sums.kernel}.cl")
    between = _source_image(writer, launch)

    stencil = launch.stencil
    if stencil:
        actual = []
        for name, read in zip(stencil.pass_.reads, launch.reads, strict=True):
            stored = f"image_at({', '.join(writer.planes(read))}, pitch, at)"
            if read.prologue:
                extra = [
                    a
                    for op in read.prologue
                    for a in writer.arguments(op, found_by(plan, op.step))
                    if a not in dict(op.literals).values()
                ]
                lines.append(f"const src_image {name} = {{{', '.join([stored, *extra])}}};")
            else:
                type_ = "src_image" if name == "src" else "image"
                lines.append(f"const {type_} {name} = {stored};")
            actual.append(name)
        arguments = writer.arguments(stencil, found_by(plan, stencil.step))
        pattern = [a for a in arguments if a.startswith("(cfa)")]
        rest = [a for a in arguments if a not in pattern]
        lines.append(
            f"const {stencil.kind.c_type} v0 = {call(stencil, 'at', [*pattern, *actual, *rest])};"
        )
        ops = ops[1:]
        kind = stencil.kind
    elif launch.reads:
        kind = launch.reads[0].image.kind
        stored = f"image_at({', '.join(writer.planes(launch.reads[0]))}, pitch, at)"
        lines.append(f"const {kind.c_type} v0 = tap_{kind.c_name}({stored}, 0, 0);")
    else:
        kind = plan.source
        dtype = "half" if plan.half else "float"
        writer.parameter("src", f"__global const {dtype} *restrict", "source")
        lines.append(f"const {kind.c_type} v0 = source_{kind.c_name}_{dtype}(src, at, e);")

    for i, op in enumerate(ops):
        kind = op.kind
        arguments = writer.arguments(op, found_by(plan, op.step))
        lines.append(f"const {kind.c_type} v{i + 1} = {call(op, f'v{i}', ['at', *arguments])};")
    value = f"v{len(ops)}"
    if launch.sums:
        lines.append(
            f"const vi sample = only_inside({launch.sums.pass_.function}({value}), at, e);"
        )
        lines.append("if (row & 1) odd_rows += sample; else even_rows += sample;")
    if launch.writes:
        slots = [writer.slot(n, True) for n in plan.slots[launch.writes.number]]
        lines.append(f"store_{kind.c_name}({', '.join([value, *slots])}, at, e);")
    if launch.encodes:
        writer.parameter("dst", "__global uchar *restrict", "encoded")
        if curves:
            writer.parameter(
                "table8",
                "__global const uchar *restrict",
                "table8",
                item=",".join(op.step for op in curves),
            )
            lines.append(f"encode_rgb_by_table({value}, table8, dst, at, e);")
        else:
            lines.append(
                f"encode_{'mosaic' if kind.c_type == 'vf' else 'rgb'}({value}, dst, at, e);"
            )
    before = after = ""
    if launch.sums:
        writer.parameter("sums", "__global int4 *restrict", "sums")
        before = "    vi even_rows = (vi)(0), odd_rows = (vi)(0);\n"
        after = (
            "    const site first = site_at(x, y);\n"
            "    const size_t block = get_global_id(1) * ((width + LANES - 1) / LANES) + "
            "get_global_id(0);\n"
            "    sums[block] = (int4)(fold_columns(even_rows, first), "
            "fold_columns(odd_rows, first));\n"
        )
    body = (
        "    const uint x = (uint)get_global_id(0) * LANES;\n"
        f"    const uint y = (uint)get_global_id(1) * {launch.rows};\n"
        f"    if (x >= width) return;\n{before}"
        f"#pragma unroll\n    for (uint row = 0; row < {launch.rows}; ++row) {{\n"
        "        const site at = site_at(x, y + row);\n"
        + "".join(f"        {line}\n" for line in lines)
        + f"    }}\n{after}"
    )
    return files, between, body


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
        value = call(op, "line", writer.arguments(op, {}))
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
