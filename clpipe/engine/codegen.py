"""Generates the OpenCL source of a launch. Pure: the source that runs is the source returned here.

A kernel's source contains the library, the stage files and one short function that loads, calls the
stages and stores. ``#line`` directives make the compiler's messages name the right file and line.

The source depends only on the operations of a launch. It does not depend on the launch's position
in the plan, its slots, the names of its steps or the border's width. Steps, planes and line tables
are numbered in the order of their first use, and the kernel's name is a digest of its source. Two
plans with the same launch therefore share its program.
"""

import hashlib

from clpipe.engine.bands import BAND, margin_of, schedule_of
from clpipe.engine.bindings import RINGS, step_buffer
from clpipe.engine.blocks import block_code, call, kernels_of, tap_function
from clpipe.engine.ir import (
    AnyLaunch,
    Bands,
    Border,
    Finalize,
    Histogram,
    Kernel,
    Launch,
    Lines,
    Plan,
    Reduce,
)
from clpipe.engine.kernel_builder import KernelBuilder, kernel_opening, sort_parameters
from clpipe.engine.sources import LIBRARY, check_plugin_names, files_text
from clpipe.engine.work_items import (
    PARTIALS,
    RUN,
    columns_of,
    group_size,
    local_size,
    round_up,
    summed_together,
)
from clpipe.reference.filter_array import MIRRORED
from clpipe.stage import LineTable

# The compiler knows that the origin is a whole number of blocks. Therefore it also knows which rows
# share a Philox call, and the phase of a Bayer pattern.
EXTENT = "{width, height, pitch, left * LANES, top * 4, columns, rows, border, 0}"
ITEM_SUMS = "(int4)(fold_columns(even_rows, first), fold_columns(odd_rows, first))"
UNNAMED = "kernel_without_a_name_yet"  # stands for the name in the text that it is a digest of
STORE_SUMS = f"store_sums({ITEM_SUMS}, sums, first, e);"


def write_kernel(plan: Plan, launch: AnyLaunch | Border, lanes: int) -> Kernel:
    """Return the OpenCL source of one launch of a plan, for a device with ``lanes`` lanes.

    Raises:
        RequestError: a plug-in's function has the name of something else in the source.
    """
    builder = KernelBuilder(plan, lanes)
    for number in ("width", "height", "pitch", "left", "top", "columns", "rows", "border"):
        builder.number(number)
    seen: set[str] = set()
    text = f"#define LANES {lanes}\n#define COLUMNS {columns_of(launch, lanes)}\n"
    text += f"#define RUN {RUN}\n"
    text += files_text([f"lib/{part}.h" for part in LIBRARY], seen)
    match launch:
        case Launch(bands=bands) if bands:
            body = _bands(builder, launch, bands)
            text += _functions_of_bands(builder, bands, seen)
        case Launch():
            body = _whole_image(builder, launch)
            text += _functions(builder, launch, seen)
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
    size = group_size(launch, lanes)
    setup = "".join(f"    {line}\n" for line in builder.setup)
    opening_lines = "".join(f"    {line}\n" for line in table_reads)
    # The hint prevents Intel's compiler from vectorising our vectors, up to nine times slower.
    text += (
        '#line 1 "launch"\n'
        f"__kernel __attribute__((vec_type_hint(vf), reqd_work_group_size({size}, 1, 1)))\nvoid "
    )
    function = (
        f"(\n    {signature})\n{{\n{opening_lines}    const extent e = {EXTENT};\n{setup}{body}}}\n"
    )
    check_plugin_names(seen, function)
    name = f"launch_{hashlib.sha256(f'{text}{UNNAMED}{function}'.encode()).hexdigest()[:16]}"
    source = f"{text}{name}{function}"
    return Kernel(name, source, tuple(parameters.values()), launch, tuple(sorted(seen)))


def _bands(builder: KernelBuilder, launch: Launch, bands: Bands) -> str:
    """Return the body of a kernel that runs launches in bands: each work item computes a strip."""
    schedule, lanes = schedule_of(bands), builder.lanes
    builder.rings = schedule.rings
    columns, rows = builder.strip("columns"), builder.strip("rows")
    buffer = builder.buffer("strips", "float", RINGS, written=True)
    margin = margin_of(bands, lanes)
    lines = [
        f"const int strip_left = left * LANES + (uint)get_global_id(0) * {columns};",
        f"const int strip_top = top * 4 + (uint)get_global_id(1) * {rows};",
        "const int right = left * LANES + columns, bottom = top * 4 + rows;",
        f"const int strip_right = int_min(strip_left + (int){columns}, right);",
        f"const int strip_bottom = int_min(strip_top + (int){rows}, bottom);",
        "if (strip_left >= strip_right || strip_top >= strip_bottom) return;",
        f"const size_t ring_pitch = {columns} + {2 * margin};",
        f"const uint strips_across = (columns + {columns} - 1) / {columns};",
        "const size_t strip = get_global_id(1) * strips_across + get_global_id(0);",
        f"{buffer} += strip * ring_pitch * {schedule.rows} + {margin} - strip_left;",
    ]
    for ring in schedule.rings.values():
        shape = f"(uint)ring_pitch, 0, 0, width, height, {ring.border}, {ring.rows}"
        lines.append(f"const extent {builder.extent(ring.image)} = {{width, height, {shape}}};")
        for channel, plane in enumerate(builder.planes_of(ring.image, written=True)):
            offset = ring.offset + channel * ring.rows
            lines.append(f"__global float *const {plane} = {buffer} + {offset} * ring_pitch;")
    # Launches that are ahead need rows from before the strip, so the first bands are partial.
    before = round_up(2 * max(schedule.leads), BAND)
    lines.append(f"for (int band = strip_top - {before}; band < strip_bottom; band += {BAND}) {{")
    for number, part in enumerate(bands.parts):
        lead, overlap = schedule.leads[number], schedule.overlaps[number]
        vectors, high = columns_of(part, lanes), part.rows
        wide = lanes * vectors
        code = block_code(builder, part, str(number), str(vectors))
        lines += [
            f"{{ // {part.name}",
            f"const int low = int_max(strip_top - {lead}, (int)top * 4);",
            f"const int high = int_min(strip_bottom + {lead}, bottom);",
            f"const int begin = int_clamp(band + {lead}, low, high) + {high - 1};",
            f"const int end = int_clamp(band + {lead + BAND}, low, high) + {high - 1};",
            f"const int from_x = int_max(strip_left - {overlap}, (int)left * LANES);",
            f"const int to_x = int_min(strip_right + {overlap}, right);",
            # Positions are multiples of a block's size, so that the compiler knows their parity.
            f"for (uint j = begin / {high}; j < end / {high}; ++j) {{",
            f"for (uint i = from_x / {wide}; i * {wide} < to_x; ++i) {{",
            f"const uint x = i * {wide}, y = j * {high};",
            code,
            *([STORE_SUMS] if part.sums else []),
            "}}}",
        ]
    return "\n".join([*lines, "}"]) + "\n"


def _functions(builder: KernelBuilder, launch: Launch, seen: set[str]) -> str:
    """Return the functions that a launch calls.

    The stencil calls the tap function, and this calls the passes that it recomputes.
    """
    text = files_text(kernels_of([op for r in launch.reads for op in r.prologue]), seen)
    text += tap_function(builder, launch)
    return text + files_text(kernels_of([*launch.ops, launch.sums]), seen)


def _functions_of_bands(builder: KernelBuilder, bands: Bands, seen: set[str]) -> str:
    """Return the functions that launches in bands call.

    Each launch has a tap function with its own name, or shares an equal one. The file of a stencil
    is compiled for the taps and the columns of the launch that it opens, even if an earlier launch
    needs another function of the file.
    """
    texts: list[str] = []
    with_taps: set[int] = set()
    first_with: dict[str, int] = {}  # the first launch with a text of the tap function
    openers: dict[str, int] = {}
    for number, part in enumerate(bands.parts):
        if part.stencil:
            openers.setdefault(part.ops[0].kernel, number)

    def include(file: str) -> None:
        if file in seen:
            return
        if (number := openers.get(file)) is None:
            texts.append(files_text([file], seen))
            return
        add_taps(number)
        columns = columns_of(bands.parts[number], builder.lanes)
        texts.append(f"#undef COLUMNS\n#define COLUMNS {columns}\n")
        texts.append(f"#define src_image src_image{number}\n#define src_tap src_tap{number}\n")
        texts.append(files_text([file], seen) + "#undef src_image\n#undef src_tap\n")

    def add_taps(number: int) -> None:
        if number not in with_taps:
            with_taps.add(number)
            for read in bands.parts[number].reads:
                for op in read.prologue:
                    include(op.kernel)
            first = first_with.setdefault(tap_function(builder, bands.parts[number]), number)
            if first == number:
                texts.append(tap_function(builder, bands.parts[number], str(number)))
            else:  # of one type, because the functions of a file are compiled once
                texts.append(f"typedef src_image{first} src_image{number};\n")
                texts.append(f"#define src_tap{number} src_tap{first}\n")

    for number, part in enumerate(bands.parts):
        add_taps(number)
        for file in kernels_of([*part.ops, part.sums]):
            include(file)
    return "".join(texts)


def _whole_image(builder: KernelBuilder, launch: Launch) -> str:
    """Return the body of a kernel over the image, with one block for each work item."""
    position = (
        f"    const uint x = left * LANES + (uint)get_global_id(0) * (COLUMNS * LANES);\n"
        f"    const uint y = top * 4 + (uint)get_global_id(1) * {launch.rows};\n"
    )
    rows = block_code(builder, launch)
    inside = "x - e.left < columns && y - e.top < rows"  # members of a stack may differ in size
    outside = "x - e.left >= columns || y - e.top >= rows"
    if not launch.sums:
        return f"{position}    if ({outside}) return;\n{rows}"
    if (together := summed_together(builder.lanes)) == 1:
        return f"{position}    if ({outside}) return;\n{rows}    {STORE_SUMS}\n"
    # No work item may return before a barrier.
    return (
        f"    __local int4 group[{together}];\n{position}    int4 own = (int4)(0);\n"
        f"    if ({inside}) {{\n{rows}    own = {ITEM_SUMS};\n    }}\n"
        "    store_group_sums(own, group, sums);\n"
    )


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
