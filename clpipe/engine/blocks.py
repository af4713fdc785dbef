"""Generates the code of a block: the pixels that one work item computes at a time. Pure."""

from collections.abc import Sequence

from clpipe.engine.bindings import step_buffer
from clpipe.engine.ir import Launch, Read
from clpipe.engine.kernel_builder import KernelBuilder
from clpipe.engine.ops import Op
from clpipe.engine.work_items import columns_of
from clpipe.stage import Kind, TableLookup


def call(op: Op, arguments: Sequence[str]) -> str:
    """Return the call of a pass's function."""
    return f"{op.pass_.function}({', '.join(arguments)})"


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


def tap_function(builder: KernelBuilder, launch: Launch) -> str:
    """Return the type and tap function of a stencil's ``src``, which recomputes passes at taps."""
    if not launch.stencil:
        return ""
    read = launch.src
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
    images = [builder.image(read, "0" if fills_block else "ROW") for read in launch.reads]
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
    index = "row * COLUMNS + column" if columns_of(launch, builder.lanes) > 1 else "ROW"
    return per_item, [f"const {kind.c_type} v0 = block[{index}];"], kind


def _encode(builder: KernelBuilder, value: str, kind: Kind, curves: Sequence[Op]) -> list[str]:
    """Return the lines that compute eight-bit pixels, through one table if curves come last.

    All but the last line need only the value. The last line stores.
    """
    builder.buffer("dst", "uchar", "dst", written=True)
    if kind.c_type == "vf":
        return [f"encode_mosaic({value}, dst, at, e);"]
    table = f"{builder.table8(curves)}, true" if curves else "0, false"
    codes = f"codes[ROW] = {'indices' if curves else 'levels'}_of({value});"
    return [codes, f"store_levels(codes + ROW, {table}, dst, at, e);"]


def block_code(builder: KernelBuilder, launch: Launch) -> str:
    """Return the code of a block: it loads, calls the stages and stores.

    The block begins at the variables ``x`` and ``y``. With sums, the code leaves them in
    ``even_rows`` and ``odd_rows``.
    """
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
    wide = columns_of(launch, builder.lanes) > 1
    if not wide:
        # Compute all rows before the first store. The compiler can then share work between rows,
        # because no store can change their inputs.
        per_item.append(
            f"{kind.c_type} {', '.join(f'values_{row}' for row in range(launch.rows))};"
        )
        lines.append(f"values_ROW = {value};")
        value = "values_ROW"
    writes, encodes = [], list[str]()
    if launch.writes:
        extent = builder.extent(launch.writes)
        planes = builder.planes_of(launch.writes, True)
        writes.append(f"store_{kind.c_name}({', '.join([value, *planes])}, at, {extent});")
    if launch.encodes:
        encodes = _encode(builder, value, kind, curves)
        if len(encodes) > 1:
            per_item.append(f"levels codes[{launch.rows}];")
    if wide:
        encodes = [line.replace("ROW", "row") for line in encodes]
        body = _block_loop([*lines, *writes, *encodes], launch)
    else:
        extent = builder.extent(launch.writes) if launch.writes else "e"
        body = _unrolled_rows(lines, launch.rows) + _store(writes, kind, launch.rows, extent)
        body += _unrolled_rows(encodes[:-1], launch.rows)
        unrolled = builder.lanes == 1 or len(encodes) == 1
        body += _row_loop(encodes[-1:], launch.rows, unrolled)
    rows = "".join(f"    {line}\n" for line in [*per_item, *body])
    return f"    const site first = site_at(x, y);\n{rows}"


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


def _row_loop(lines: Sequence[str], rows: int, unrolled: bool) -> list[str]:
    """Return the lines for each row of a work item, in a loop unless ``unrolled``."""
    if unrolled or not lines:
        return _unrolled_rows(lines, rows)
    return [
        "#pragma unroll 1",
        f"for (uint row = 0; row < {rows}; ++row) {{",
        "    const site at = shifted(first, 0, row);",
        *(f"    {line.replace('ROW', 'row')}" for line in lines),
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


def _store(writes: Sequence[str], kind: Kind, rows: int, extent: str) -> list[str]:
    """Return the stores of all rows of a work item, with a separate, slower loop near edges."""
    if not writes:
        return []
    inside = [line.replace("(", "_inside(", 1) for line in writes]
    selection = "".join(f"row == {row} ? values_{row} : " for row in range(rows - 1))
    return [
        f"if (near_edge(first, {rows}, {extent})) {{",
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
