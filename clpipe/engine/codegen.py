"""Generates the OpenCL source of a launch. Pure: the source that runs is the source returned here.

A kernel's source contains the library, the stage files and one short function that loads, calls the
stages and stores. ``#line`` directives make the compiler's messages name the right file and line.

The source depends only on the operations of a launch. It does not depend on the launch's position
in the plan, its slots, the names of its steps or the border's width. Steps, planes and line tables
are numbered in the order of their first use, and the kernel's name is a digest of its source. Two
plans with the same launch therefore share its program.
"""

import hashlib
from collections.abc import Sequence

from clpipe.engine.bindings import step_buffer
from clpipe.engine.ir import (
    AnyLaunch,
    Border,
    Finalize,
    Histogram,
    Kernel,
    Launch,
    Lines,
    Plan,
    Read,
    Reduce,
)
from clpipe.engine.kernel_builder import KernelBuilder, kernel_opening, sort_parameters
from clpipe.engine.ops import Op
from clpipe.engine.sources import LIBRARY, files_text
from clpipe.engine.work_items import PARTIALS, RUN, columns_of, local_size, summed_together
from clpipe.reference.filter_array import MIRRORED
from clpipe.stage import Kind, LineTable, TableLookup

# The compiler knows that the origin is a whole number of blocks. Therefore it also knows which rows
# share a Philox call, and the phase of a Bayer pattern.
EXTENT = "{width, height, pitch, left * LANES, top * 4, columns, rows, border}"
PLACEHOLDER_NAME = "kernel_without_a_name_yet"


def call(op: Op, arguments: Sequence[str]) -> str:
    """Return the call of a pass's function."""
    return f"{op.pass_.function}({', '.join(arguments)})"


def write_kernel(plan: Plan, launch: AnyLaunch | Border, lanes: int) -> Kernel:
    """Return the OpenCL source of one launch of a plan, for a device with ``lanes`` lanes."""
    builder = KernelBuilder(plan, lanes)
    for number in ("width", "height", "pitch", "left", "top", "columns", "rows", "border"):
        builder.number(number)
    seen: set[str] = set()
    text = f"#define LANES {lanes}\n#define COLUMNS {columns_of(launch, lanes)}\n"
    text += f"#define RUN {RUN}\n"
    text += files_text([f"lib/{part}.h" for part in LIBRARY], seen)
    match launch:
        case Launch():
            body = _pixels(builder, launch)
            # The tap function calls the stages of its prologue, and the stencil calls it.
            text += files_text(kernels_of([op for r in launch.reads for op in r.prologue]), seen)
            text += _source_image(builder, launch)
            text += files_text(kernels_of([*launch.ops, launch.sums]), seen)
        case Lines():
            body = _lines(builder, launch)
            text += files_text(kernels_of(launch.ops), seen)
        case Histogram():
            body = _histogram(builder, launch)
            text += files_text(kernels_of([launch.op]), seen)
        case Reduce():
            body = _reduce(builder, launch)
        case Finalize():
            body = _finalize(builder, launch)
            text += files_text(kernels_of([launch.op]), seen)
        case Border():
            at = "(uint)get_global_id(0), (uint)get_global_id(1)"
            period_rows, period_columns = (
                n if n > MIRRORED else 0 for n in launch.period or (0, 0)
            )
            plane = builder.slot(launch.slot, True)
            # The members of a stack may differ in size.
            body = (
                "    if (get_global_id(1) >= rows + 2 * border) return;\n"
                f"    fill_border({plane}, {at}, {period_rows}, {period_columns}, e);\n"
            )
    parameters = sort_parameters(builder.parameters)
    declared, table_reads = kernel_opening(parameters)
    signature = ",\n    ".join(declared)
    size = 1 if isinstance(launch, Finalize) else local_size(lanes)
    setup = "".join(f"    {line}\n" for line in builder.setup)
    opening_lines = "".join(f"    {line}\n" for line in table_reads)
    # The hint prevents Intel's compiler from vectorising our vectors, up to nine times slower.
    text += (
        '#line 1 "launch"\n'
        f"__kernel __attribute__((vec_type_hint(vf), reqd_work_group_size({size}, 1, 1)))\n"
        f"void {PLACEHOLDER_NAME}(\n    {signature})\n{{\n{opening_lines}"
        f"    const extent e = {EXTENT};\n{setup}{body}}}\n"
    )
    name = f"launch_{hashlib.sha256(text.encode()).hexdigest()[:16]}"
    source = text.replace(PLACEHOLDER_NAME, name)
    return Kernel(name, source, tuple(parameters.values()), launch, tuple(sorted(seen)))


def kernels_of(ops: Sequence[Op | None]) -> list[str]:
    """Return the kernel files of these passes."""
    return [op.kernel for op in ops if op]


def _prologue(builder: KernelBuilder, read: Read) -> list[tuple[Op, list[str], list[str]]]:
    """Return the passes recomputed at a tap, with their arguments and their run-time arguments."""
    calls = []
    for op in read.prologue:
        arguments = builder.arguments(op)
        literals = dict(op.literals).values()
        calls.append((op, arguments, [a for a in arguments if a not in literals]))
    return calls


def _source_image(builder: KernelBuilder, launch: Launch) -> str:
    """Return the type and tap function of a stencil's ``src``, which recomputes passes at taps."""
    if not launch.stencil:
        return ""
    reads = dict(zip(launch.ops[0].pass_.reads, launch.reads, strict=True))
    read = reads.get("src")
    if not read or not read.prologue:
        kind = read.image.kind if read else launch.ops[0].source
        return (
            "typedef image src_image;\n"
            f"INLINE {kind.c_type} src_tap(src_image src, int dx, int dy) "
            f"{{ return tap_{kind.c_name}(src, dx, dy); }}\n"
        )
    fields = ""
    value = f"tap_{read.image.kind.c_name}(src.stored, dx, dy)"
    for op, arguments, values in _prologue(builder, read):
        fields += "".join(f"float {v}; " for v in values)
        value = call(op, [value, "at", *(f"src.{a}" if a in values else a for a in arguments)])
    return (
        f"typedef struct {{ image stored; {fields}}} src_image;\n"
        f"INLINE {read.prologue[-1].kind.c_type} src_tap(src_image src, int dx, int dy) {{\n"
        f"    const site at = shifted(src.stored.at, dx, dy);\n    return {value};\n}}\n"
    )


def _load(builder: KernelBuilder, launch: Launch) -> tuple[list[str], list[str], Kind]:
    """Return the lines that compute ``v0`` from the source, a stored image or a stencil.

    Returns:
        The lines per work item (for a stencil that computes a whole block), the lines per row, and
        the kind of ``v0``.
    """
    plan, op = builder.plan, launch.opener
    if not launch.reads:
        kind, dtype = plan.source, "half" if plan.half else "float"
        builder.buffer("src", dtype, "src")
        source = f"source_{kind.c_name}_{dtype}{'_planes' if plan.planar else ''}"
        return [], [f"const {kind.c_type} v0 = {source}(src, at, e);"], kind
    fills_block = launch.stencil and launch.stencil.vectors_per_row
    images = [
        f"image_at({', '.join(builder.planes(read))}, e, first, {'0' if fills_block else 'ROW'})"
        for read in launch.reads
    ]
    if not op:
        kind = launch.reads[0].image.kind
        return [], [f"const {kind.c_type} v0 = tap_{kind.c_name}({images[0]}, 0, 0);"], kind
    if not launch.stencil:
        larger = builder.input_extent()
        planes = [f"image_origin({p}, {larger})" for p in builder.planes(launch.reads[0])]
        expression = call(
            op,
            [
                "at",
                *planes,
                larger,
                *builder.resampling_arguments(launch.level - 1),
                *builder.arguments(op),
            ],
        )
        return [], [f"const {op.kind.c_type} v0 = {expression};"], op.kind
    lines = []
    for name, read, stored in zip(op.pass_.reads, launch.reads, images, strict=True):
        values = [v for _, _, tap_values in _prologue(builder, read) for v in tap_values]
        type_ = "src_image" if name == "src" else "image"
        expression = f"{{{', '.join([stored, *values])}}}" if values else stored
        lines.append(f"const {type_} {name} = {expression};")
    kind, arguments = op.kind, [*op.pass_.reads, *builder.arguments(op)]
    if not fills_block:
        return [], [*lines, f"const {kind.c_type} v0 = {call(op, ['at', *arguments])};"], kind
    lines.append(f"{call(op, ['first', *arguments, 'block'])};")
    size = launch.rows * columns_of(launch, builder.lanes)
    per_item = [f"{kind.c_type} block[{size}];", "{", *(f"    {x}" for x in lines), "}"]
    index = "ROW" if builder.lanes == 1 else "row * COLUMNS + column"
    return per_item, [f"const {kind.c_type} v0 = block[{index}];"], kind


def _encode(builder: KernelBuilder, value: str, kind: Kind, curves: Sequence[Op]) -> str:
    """Return the line that writes eight-bit pixels, through one table if curves come last."""
    builder.buffer("dst", "uchar", "dst", written=True)
    if not curves:
        return f"encode_{'mosaic' if kind.c_type == 'vf' else 'rgb'}({value}, dst, at, e);"
    return f"encode_rgb_by_table({value}, {builder.table8(curves)}, dst, at, e);"


def _pixels(builder: KernelBuilder, launch: Launch) -> str:
    """Return the body of a kernel over the image: it loads, calls the stages and stores."""
    plan = builder.plan
    per_item, lines, kind = _load(builder, launch)
    ops = list(launch.ops[1:] if launch.opener else launch.ops)
    curves: list[Op] = []
    if launch.encodes and not launch.writes:
        while ops and isinstance(ops[-1].pass_.access, TableLookup):
            curves.insert(0, ops.pop())
    for i, op in enumerate(ops):
        kind = op.kind
        expression = call(op, [f"v{i}", "at", *builder.arguments(op)])
        lines.append(f"const {kind.c_type} v{i + 1} = {expression};")
    value = f"v{len(ops)}"
    if launch.sums:
        builder.buffer("sums", "int4", step_buffer("sums", launch.sums.step), written=True)
        sample = call(launch.sums, [value, "at", *builder.arguments(launch.sums)])
        lines.append(f"const vi sample = only_inside({sample}, at, {builder.core()});")
        lines.append("if (ROW & 1) odd_rows += sample; else even_rows += sample;")
        per_item.append("vi even_rows = (vi)(0), odd_rows = (vi)(0);")
    wide = launch.stencil and launch.stencil.vectors_per_row and builder.lanes > 1
    if not wide:
        # Compute all rows before the first store. The compiler can then share work between rows,
        # because no store can change their inputs.
        per_item.append(
            f"{kind.c_type} {', '.join(f'values_{row}' for row in range(launch.rows))};"
        )
        lines.append(f"values_ROW = {value};")
        value = "values_ROW"
    writes, encodes = [], []
    if launch.writes:
        slots = [builder.slot(n, True) for n in plan.slots[launch.writes.number]]
        writes.append(f"store_{kind.c_name}({', '.join([value, *slots])}, at, e);")
    if launch.encodes:
        encodes.append(_encode(builder, value, kind, curves))
    if wide:
        body = _block_loop([*lines, *writes, *encodes], launch)
    else:
        body = _unrolled_rows(lines, launch.rows) + _store(writes, kind, launch.rows)
        body += _unrolled_rows(encodes, launch.rows)
    position = (
        f"    const uint x = left * LANES + (uint)get_global_id(0) * (COLUMNS * LANES);\n"
        f"    const uint y = top * 4 + (uint)get_global_id(1) * {launch.rows};\n"
    )
    rows = "".join(f"    {line}\n" for line in [*per_item, *body])
    rows = f"    const site first = site_at(x, y);\n{rows}"
    inside = "x - e.left < columns && y - e.top < rows"  # members of a stack may differ in size
    outside = "x - e.left >= columns || y - e.top >= rows"
    if not launch.sums:
        return f"{position}    if ({outside}) return;\n{rows}"
    item_sums = "(int4)(fold_columns(even_rows, first), fold_columns(odd_rows, first))"
    if (group_size := summed_together(builder.lanes)) == 1:
        store = f"    store_sums({item_sums}, sums, e);\n"
        return f"{position}    if ({outside}) return;\n{rows}{store}"
    # No work item may return before a barrier.
    return (
        f"    __local int4 group[{group_size}];\n{position}    int4 own = (int4)(0);\n"
        f"    if ({inside}) {{\n{rows}    own = {item_sums};\n    }}\n"
        "    store_group_sums(own, group, sums);\n"
    )


def _block_loop(lines: Sequence[str], launch: Launch) -> list[str]:
    """Return loops over the vectors of a stencil's block. It is in memory, so they stay rolled."""
    return [
        "#pragma unroll 1",
        f"for (uint row = 0; row < {launch.rows}; ++row) {{",
        "    for (uint column = 0; column < COLUMNS; ++column) {",
        "        if (x - e.left + column * LANES >= columns) break;",
        "        const site at = site_at(x + column * LANES, y + row);",
        *(f"        {line}" for line in lines),
        "    }",
        "}",
    ]


def _unrolled_rows(lines: Sequence[str], rows: int) -> list[str]:
    """Return the lines for each row of a work item, unrolled, with the row's number for ROW.

    Loops are not possible: Mesa's compiler mixes up an array that one loop fills and another reads.
    """
    if not lines:
        return []
    site = "const site at = shifted(first, 0, ROW);"
    scope = ["{", *(f"    {line}" for line in [site, *lines]), "}"]
    return [line.replace("ROW", str(row)) for row in range(rows) for line in scope]


def _store(writes: Sequence[str], kind: Kind, rows: int) -> list[str]:
    """Return the stores of all rows of a work item, with a separate, slower loop near edges."""
    if not writes:
        return []
    inside = [line.replace("(", "_inside(", 1) for line in writes]
    selection = "".join(f"row == {row} ? values_{row} : " for row in range(rows - 1))
    return [
        f"if (near_edge(first, {rows}, e)) {{",
        "#pragma unroll 1",
        f"    for (uint row = 0; row < {rows}; ++row) {{",
        "        const site at = shifted(first, 0, row);",
        f"        const {kind.c_type} value = {selection}values_{rows - 1};",
        *(f"        {line.replace('values_ROW', 'value')}" for line in writes),
        "    }",
        "} else {",
        *(f"    {line}" for line in _unrolled_rows(inside, rows)),
        "}",
    ]


def _lines(builder: KernelBuilder, launch: Lines) -> str:
    body = "    const uint i = (uint)get_global_id(0) * LANES;\n"
    body += "    const vu line = lane_indices(i);\n"
    for op in launch.ops:
        table = builder.lines(op.step, op.pass_.writes, written=True)
        assert isinstance(op.pass_.access, LineTable)
        count = "height" if op.pass_.access.axis == "rows" else "width"
        value = call(op, ["line", *builder.arguments(op)])
        body += f"    if (i < {count}) store({value}, {table} + i);\n"
    return body


def _histogram(builder: KernelBuilder, launch: Histogram) -> str:
    op, bins = launch.op, launch.op.reduction.bins
    read = launch.reads[0]
    planes = builder.planes(read)[: len(read.image.kind.channels)]
    origins = [f"origin{i}" for i in range(len(planes))]
    buffer = step_buffer("counts", op.step)
    counts = builder.buffer("counts", "uint", buffer, written=True, restrict=False)
    arguments = [*origins, "x", "y", "e", *builder.arguments(op)]
    core = builder.core()
    if builder.lanes == 1:  # a work-group counts together, each work item in different columns
        row, first, step = "get_group_id(0)", "(uint)get_local_id(0)", "(uint)get_local_size(0)"
        barrier, count = "    barrier(CLK_GLOBAL_MEM_FENCE);\n", "atomic_inc(own + bin)"
    else:
        row, first, step, barrier, count = "get_global_id(0)", "0", "1", "", "own[bin] += 1"
    starts = "".join(
        f"    __global const float *{origin} = image_origin({plane}, e);\n"
        for origin, plane in zip(origins, planes, strict=True)
    )
    return (
        f"{starts}"
        f"    __global uint *own = {counts} + (size_t){row} * {bins};\n"
        f"    for (uint k = {first}; k < {bins}; k += {step}) own[k] = 0;\n{barrier}"
        f"    for (uint y = {core}.top + {row}; y < {core}.bottom; y += {PARTIALS}) {{\n"
        f"        for (uint x = {core}.left + {first}; x < {core}.right; x += {step}) {{\n"
        f"            const int bin = {call(op, arguments)};\n"
        f"            if (bin >= 0) {count};\n"
        "        }\n    }\n"
    )


def _reduce(builder: KernelBuilder, launch: Reduce) -> str:
    tile, step = builder.tile_number(), launch.op.step

    def buffer(name: str, element: str, written: bool) -> None:
        builder.buffer(name, element, step_buffer(name, step), written, restrict=False)

    if bins := launch.op.reduction.bins:
        buffer("counts", "uint", written=False)
        buffer("histogram", "uint", written=True)
        arguments = f"counts, histogram, {bins}, {PARTIALS}, {tile}"
        if builder.lanes > 1:
            return f"    add_up_counts({arguments});\n"
        group = f"    __local uint group[{local_size(builder.lanes)}];\n"
        return f"{group}    add_up_counts({arguments}, group);\n"
    buffer("sums", "int4", written=False)
    buffer("partials", "long4", written=True)
    return f"    add_up_blocks(sums, partials, {builder.number('blocks')}, {tile});\n"


def _finalize(builder: KernelBuilder, launch: Finalize) -> str:
    reduction, step = launch.op.reduction, launch.op.step
    content, element = ("histogram", "uint") if reduction.bins else ("partials", "long4")
    total = builder.buffer(content, element, step_buffer(content, step), restrict=False)
    if not reduction.bins:
        total = f"add_up_partials(partials, {PARTIALS})"
    estimates = builder.estimates(step, written=True)
    arguments = builder.arguments(launch.op, reduction.finish_arguments)
    call_arguments = [total, *arguments, "e", estimates]
    return f"    {reduction.finish}({', '.join(call_arguments)});\n"
