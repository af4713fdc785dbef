"""Generates the code of a block: the pixels that one work item computes at a time. Pure."""

from collections.abc import Callable, Sequence

from clpipe.engine.bindings import step_buffer
from clpipe.engine.ir import Launch, Read
from clpipe.engine.kernel_builder import KernelBuilder
from clpipe.engine.ops import Op
from clpipe.engine.work_items import columns_of
from clpipe.stage import Kind, TableLookup

# The lines of one row of a work item, from the row: its number, or a variable.
Row = Callable[[str], list[str]]


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


def tap_function(builder: KernelBuilder, launch: Launch, part: str = "") -> str:
    """Return the type and tap function of a stencil's ``src``, which recomputes passes at taps.

    ``part`` ends their names, which differ between the launches of a kernel in bands.
    """
    if not launch.stencil:
        return ""
    read = launch.src
    if not read or not read.prologue:
        kind = read.image.kind if read else launch.ops[0].source
        return (
            f"typedef image src_image{part};\n"
            f"INLINE {kind.c_type} src_tap{part}(src_image{part} src, int dx, int dy) "
            f"{{ return tap_{kind.c_name}(src, dx, dy); }}\n"
        )
    fields = ""
    value = f"tap_{read.image.kind.c_name}(src.stored, dx, dy)"
    for op, arguments, values in _prologue(builder, read):
        fields += "".join(f"float {v}; " for v in values)
        value = call(op, [value, "at", *(f"src.{a}" if a in values else a for a in arguments)])
    return (
        f"typedef struct {{ image stored; {fields}}} src_image{part};\n"
        f"INLINE {read.prologue[-1].kind.c_type} "
        f"src_tap{part}(src_image{part} src, int dx, int dy) {{\n"
        f"    const site at = shifted(src.stored.at, dx, dy);\n    return {value};\n}}\n"
    )


def _load(
    builder: KernelBuilder, launch: Launch, part: str, columns: str
) -> tuple[list[str], Row, Kind]:
    """Return the lines that compute ``v0`` from the source, a stored image or a stencil.

    Returns:
        The lines per work item (for a stencil that computes a whole block), the lines per row, and
        the kind of ``v0``.
    """
    plan, op = builder.plan, launch.opener

    def first(expression: str, kind: Kind) -> str:
        return f"const {kind.c_type} v0 = {expression};"

    if not launch.reads:
        kind, dtype = plan.source, "half" if plan.half else "float"
        builder.buffer("src", dtype, "src")
        layout = f"{dtype}{'_planes' if plan.planar else ''}"
        source = f"{op.pass_.function if op else f'source_{kind.c_name}'}_{layout}"
        values = ["src", "at", "e", *(builder.arguments(op) if op else ())]
        return [], lambda row: [first(f"{source}({', '.join(values)})", kind)], kind
    images = [builder.image(read) for read in launch.reads]
    if not op:
        kind = launch.reads[0].image.kind
        return [], lambda row: [first(f"tap_{kind.c_name}({images[0](row)}, 0, 0)", kind)], kind
    kind = op.kind
    if not launch.stencil:
        larger = builder.input_extent()
        planes = [f"image_origin({p}, {larger})" for p in builder.planes(launch.reads[0])]
        taps = builder.resampling_arguments(launch.level - 1)
        resampled = call(op, ["at", *planes, larger, *taps, *builder.arguments(op)])
        return [], lambda row: [first(resampled, kind)], kind
    sources: list[Callable[[str], str]] = []
    for name, read, stored in zip(op.pass_.reads, launch.reads, images, strict=True):
        values = [v for _, _, tap_values in _prologue(builder, read) for v in tap_values]
        sources.append(_source(name, stored, values, part))
    arguments = [*op.pass_.reads, *builder.arguments(op)]
    if not launch.stencil.vectors_per_row:
        value = call(op, ["at", *arguments])
        return [], lambda row: [*(each(row) for each in sources), first(value, kind)], kind
    lines = [*(each("0") for each in sources), f"{call(op, ['first', *arguments, 'block'])};"]
    wide = columns_of(launch, builder.lanes)
    per_item = [
        *(f"{kind.c_type} block[{launch.rows * wide}];", "{"),
        *(f"    {line}" for line in lines),
        "}",
    ]
    index = f"row * {columns} + column" if wide > 1 else ""
    return per_item, lambda row: [first(f"block[{index or row}]", kind)], kind


def _source(
    name: str, stored: Callable[[str], str], values: Sequence[str], part: str
) -> Callable[[str], str]:
    """Return a function from a row to the declaration of an image that a stencil reads.

    Args:
        name: the name of the image in the pass.
        stored: a function from a row to the stored image.
        values: the run-time arguments of passes that are recomputed at its taps.
        part: the end of the name of its type.
    """
    type_ = f"src_image{part}" if name == "src" else "image"

    def declaration(row: str) -> str:
        value = f"{{{', '.join([stored(row), *values])}}}" if values else stored(row)
        return f"const {type_} {name} = {value};"

    return declaration


def _encode(
    builder: KernelBuilder, kind: Kind, curves: Sequence[Op]
) -> tuple[Callable[[str, str], str] | None, Callable[[str, str], str]]:
    """Return what computes eight-bit pixels, through one table if curves come last.

    Returns:
        Two functions from a row and its value to a line. The first line needs only the value, and
        the second one stores. There may be no first one.
    """
    builder.buffer("dst", "uchar", "dst", written=True)
    if kind.c_type == "vf":
        return None, lambda row, value: f"encode_mosaic({value}, dst, at, e);"
    table = f"{builder.table8(curves)}, true" if curves else "0, false"
    function = f"{'indices' if curves else 'levels'}_of"
    return (
        lambda row, value: f"codes[{row}] = {function}({value});",
        lambda row, value: f"store_levels(codes + {row}, {table}, dst, at, e);",
    )


def block_code(
    builder: KernelBuilder, launch: Launch, part: str = "", columns: str = "COLUMNS"
) -> str:
    """Return the code of a block: it loads, calls the stages and stores.

    The block begins at the variables ``x`` and ``y``. With sums, the code leaves them in
    ``even_rows`` and ``odd_rows``.

    Args:
        builder: collects the parameters of the kernel.
        launch: the launch.
        part: the end of the names of its tap function, see :func:`tap_function`.
        columns: the number of vectors in a row of the block.
    """
    per_item, load, kind = _load(builder, launch, part, columns)
    ops = list(launch.ops[1:] if launch.opener else launch.ops)
    curves: list[Op] = []
    if launch.encodes and not launch.writes:
        while ops and isinstance(ops[-1].pass_.access, TableLookup):
            curves.insert(0, ops.pop())
    calls = []
    for i, op in enumerate(ops):
        kind = op.kind
        expression = call(op, [f"v{i}", "at", *builder.arguments(op)])
        calls.append(f"const {kind.c_type} v{i + 1} = {expression};")
    last = f"v{len(ops)}"
    if launch.sums:
        builder.buffer("sums", "int4", step_buffer("sums", launch.sums.step), written=True)
        sample = call(launch.sums, [last, "at", *builder.arguments(launch.sums)])
        calls.append(f"const vi sample = only_inside({sample}, at, {builder.core()});")
        per_item.append("vi even_rows = (vi)(0), odd_rows = (vi)(0);")

    def pixel(row: str) -> list[str]:
        sums = f"if ({row} & 1) odd_rows += sample; else even_rows += sample;"
        return [*load(row), *calls, *([sums] if launch.sums else [])]

    wide = columns_of(launch, builder.lanes) > 1
    if not wide:
        # Compute all rows before the first store. The compiler can then share work between rows,
        # because no store can change their inputs.
        per_item.append(
            f"{kind.c_type} {', '.join(f'values_{row}' for row in range(launch.rows))};"
        )
    extent = builder.extent(launch.writes) if launch.writes else "e"
    planes = builder.planes_of(launch.writes, True) if launch.writes else []

    def store(value: str, suffix: str = "") -> str:
        return f"store_{kind.c_name}{suffix}({', '.join([value, *planes])}, at, {extent});"

    compute, encode = _encode(builder, kind, curves) if launch.encodes else (None, None)
    if compute:
        per_item.append(f"levels codes[{launch.rows}];")
    if wide:
        lines = [*pixel("row"), *([store(last)] if launch.writes else [])]
        lines += [line("row", last) for line in (compute, encode) if line]
        body = _block_loop(lines, launch, columns)
    else:
        body = _unrolled(lambda row: [*pixel(row), f"values_{row} = {last};"], launch.rows)
        if launch.writes:
            body += _store(store, kind, launch.rows, extent)
        if compute:
            body += _unrolled(lambda row: [compute(row, f"values_{row}")], launch.rows)
        if encode:
            unrolled = builder.lanes == 1 or not compute
            loop = _unrolled if unrolled else _row_loop
            body += loop(lambda row: [encode(row, f"values_{row}")], launch.rows)
    text = "".join(f"    {line}\n" for line in [*per_item, *body])
    return f"    const site first = site_at(x, y);\n{text}"


def _block_loop(lines: Sequence[str], launch: Launch, columns: str) -> list[str]:
    """Return loops over the vectors of a stencil's block. It is in memory, so they stay rolled."""
    return [
        "#pragma unroll 1",
        f"for (uint row = 0; row < {launch.rows}; ++row) {{",
        f"    for (uint column = 0; column < {columns}; ++column) {{",
        "        if (x - e.left + column * LANES >= columns) break;",
        "        const site at = site_at(x + column * LANES, y + row);",
        *(f"        {line}" for line in lines),
        "    }",
        "}",
    ]


def _row_loop(lines: Row, rows: int) -> list[str]:
    """Return the lines for each row of a work item, in a loop."""
    return [
        "#pragma unroll 1",
        f"for (uint row = 0; row < {rows}; ++row) {{",
        "    const site at = shifted(first, 0, row);",
        *(f"    {line}" for line in lines("row")),
        "}",
    ]


def _unrolled(lines: Row, rows: int) -> list[str]:
    """Return the lines for each row of a work item, unrolled.

    Loops are not possible: Mesa's compiler mixes up an array that one loop fills and another reads.
    """
    found = []
    for row in range(rows):
        site = f"const site at = shifted(first, 0, {row});"
        found += ["{", *(f"    {line}" for line in [site, *lines(str(row))]), "}"]
    return found


def _store(store: Callable[[str, str], str], kind: Kind, rows: int, extent: str) -> list[str]:
    """Return the stores of all rows of a work item, with a separate, slower loop near edges."""
    selection = "".join(f"row == {row} ? values_{row} : " for row in range(rows - 1))
    return [
        f"if (near_edge(first, {rows}, {extent})) {{",
        "#pragma unroll 1",
        f"    for (uint row = 0; row < {rows}; ++row) {{",
        "        const site at = shifted(first, 0, row);",
        f"        const {kind.c_type} value = {selection}values_{rows - 1};",
        f"        {store('value', '')}",
        "    }",
        "} else {",
        *(f"    {line}" for line in _unrolled(lambda r: [store(f"values_{r}", "_inside")], rows)),
        "}",
    ]
