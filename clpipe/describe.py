"""Plans, stages and devices in words, for people and for programs."""

import json
import math
import types
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import ValidationError

from clpipe.bench_batch import BatchSpeed
from clpipe.calibration.calibrate import Calibration
from clpipe.calibration.line_fit import Estimate
from clpipe.camera import Camera
from clpipe.check import Check
from clpipe.config import OUTPUT, Chain, Settings, make_chain
from clpipe.device import Found, choose
from clpipe.errors import ClpipeError, DeviceError
from clpipe.measure import UNITS, Report
from clpipe.plan import AnyLaunch, Launch, Lines, Plan, launch_bytes, reads_of
from clpipe.stage import Context, Method, Stage
from clpipe.statistics import LAGS, SIGMAS, LineNoise, gaussian_beyond

# What a camera has at every ISO, with units.
FIXED = {
    "black_level": "DN",
    "white_level": "DN",
    "bits": "",
    "white_balance_gains": "red, blue",
    "full_well": "e-",
    "tukey_lambda": "",
    "prnu": "",
    "dsnu": "e-",
    "hot_pixel_share": "",
    "hot_pixel_level": "e-",
    "dead_pixel_share": "",
}
Rows = list[tuple[str, ...]]
LIMITS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}


def plan_rows(plan: Plan) -> list[tuple[str, ...]]:
    """A row a launch: name, what opened it, stages, images read and written, bytes a pixel."""
    kept = {image.number: name for name, image in plan.kept}
    return [
        (
            launch.name,
            opener(launch, kept),
            ", ".join(stages_of(launch)),
            reads_text(plan, launch),
            writes_text(plan, launch),
            f"{launch_bytes(plan, launch, 8):.1f}",
        )
        for launch in plan.launches
    ]


def opener(launch: AnyLaunch, kept: Mapping[int, str]) -> str:
    """Why a launch is one of its own, and which stage is the cause."""
    if isinstance(launch, Lines):
        return "tables of rows and columns"
    if not isinstance(launch, Launch):
        return f"{launch.op.step}: {launch.op.pass_.access.value}"
    if launch.stencil:
        return f"{launch.stencil.step}: stencil, radius {launch.stencil.pass_.radius}"
    if not launch.reads:
        return "source"
    if name := kept.get(launch.reads[0].image.number):
        return f"{name} is kept"
    return f"{launch.ops[0].step if launch.ops else 'end'}: stored image"


def stages_of(launch: AnyLaunch) -> list[str]:
    """The steps in a launch, in order, each once; those redone at each tap are in brackets."""
    if isinstance(launch, Lines):
        return [op.step for op in launch.ops]
    if not isinstance(launch, Launch):
        return [launch.op.step]
    names = [f"({op.step})" for read in launch.reads for op in read.prologue]
    names += [op.step for op in launch.ops]
    if launch.sums:
        names.append(f"{launch.sums.step}: sums")
    return list(dict.fromkeys(names))


def slots_text(plan: Plan, number: int) -> str:
    """The slots of an image."""
    return ",".join(str(slot) for slot in plan.slots[number])


def reads_text(plan: Plan, launch: AnyLaunch) -> str:
    """What a launch reads."""
    if isinstance(launch, Launch) and not launch.reads:
        return f"source {plan.source.label}, {'half' if plan.half else 'float'}"
    return "; ".join(
        f"{r.image.kind.label} in {slots_text(plan, r.image.number)}" for r in reads_of(launch)
    )


def writes_text(plan: Plan, launch: AnyLaunch) -> str:
    """What a launch writes."""
    if not isinstance(launch, Launch):
        return ""
    kept = {image.number: name for name, image in plan.kept}
    parts = []
    if launch.writes:
        text = f"{launch.writes.kind.label} in {slots_text(plan, launch.writes.number)}"
        parts.append(text + (" (kept)" if launch.writes.number in kept else ""))
    if launch.encodes:
        parts.append("8 bit")
    return "; ".join(parts)


def plan_record(plan: Plan) -> dict[str, Any]:
    """A plan as JSON values."""
    keys = ("launch", "opened_by", "stages", "reads", "writes", "bytes_per_pixel")
    return {
        "launches": [dict(zip(keys, row, strict=True)) for row in plan_rows(plan)],
        "slots": plan.slot_count,
        "bytes_per_pixel": plan.bytes_per_pixel(8),
        "kept": [name for name, _ in plan.kept],
    }


def type_text(annotation: Any) -> str:
    """A parameter's type, in a word."""
    if get_origin(annotation) is Literal:
        return " | ".join(map(str, get_args(annotation)))
    if get_origin(annotation) is Annotated:
        return type_text(get_args(annotation)[0])
    if get_origin(annotation) is tuple:
        first, *more = get_args(annotation)
        if Ellipsis in more:
            return f"list of {type_text(first)}s"
        return f"{1 + len(more)} x {type_text(first)}"
    if get_origin(annotation) in (Union, types.UnionType):
        return " | ".join(type_text(a) for a in get_args(annotation) if a is not type(None))
    return {"float": "number", "int": "whole number"}.get(annotation.__name__, annotation.__name__)


def value_text(value: Any) -> str:
    """A parameter's value, as TOML has it.

    >>> value_text((1.0, 2.5)), value_text("bayer"), value_text(False)
    ('[1, 2.5]', '"bayer"', 'false')
    >>> value_text({"uniform": [1, 2]})
    '{ uniform = [1, 2] }'
    """
    if isinstance(value, Mapping):
        return f"{{ {', '.join(f'{key} = {value_text(v)}' for key, v in value.items())} }}"
    if isinstance(value, list | tuple):
        return f"[{', '.join(map(value_text, value))}]"
    if isinstance(value, float):
        return repr(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
    return json.dumps(value, ensure_ascii=False)


def toml_text(chain: Chain) -> str:
    """A chain as a configuration, complete: what follows camera and ISO is there as a comment, what
    is drawn as its draw.
    """
    settings = chain.settings
    draws = {key: draw.record() for key, draw in chain.draws.items()}
    lines = [
        f"camera = {value_text(draws.get('camera', settings.camera))}",
        f"iso = {value_text(draws.get('iso', settings.iso))}",
        f"seed = {value_text(settings.seed)}",
        *(f"{key} = {value_text(v)}" for key, v in settings.record().items() if key[:4] == "raw_"),
        "stages = [",
        *(f"    {value_text(step.stage.name)}," for step in chain.steps),
        "]",
    ]
    for step in chain.steps:
        method = draws.get(f"{step.name}.method", step.method.method)
        lines += ["", f"[{step.name}]", f"method = {value_text(method)}"]
        given = settings.parameters.get(step.name, {})
        for name, field in type(step.method).model_fields.items():
            extra: Any = field.json_schema_extra
            value = draws.get(f"{step.name}.{name}", getattr(step.method, name))
            if value is None or (name not in given and isinstance(method, Mapping)):
                continue  # other methods than the one in the example may not have it
            line = f"{name} = {value_text(value)}"
            if name not in given and field.default is None:
                line = f"# {line}  # automatic: {extra['auto']}"
            lines.append(
                line + (f"  # {extra['unit']}" if extra["unit"] and line[0] != "#" else "")
            )
    tables = {OUTPUT: settings.output.model_dump(exclude_defaults=True)}
    if draws:  # which may follow what stands elsewhere
        ran = {step.name for step in chain.steps}
        tables |= {k: dict(t) for k, t in settings.parameters.items() if k not in ran}
    for key, draw in draws.items():
        table, _, name = key.partition(".")
        if table in tables:
            tables[table][name] = draw
    for name, table_ in tables.items():
        if table_:
            lines += ["", f"[{name}]", *(f"{k} = {value_text(v)}" for k, v in table_.items())]
    return "\n".join(lines) + "\n"


def resolved(method: type[Method], context: Context) -> dict[str, str]:
    """The values that automatic parameters of a method take in a context, as text."""
    automatic = [name for name, field in method.model_fields.items() if field.default is None]
    try:
        values = method().resolve(context)
    except ValidationError:  # it must be given something
        values = method.model_validate(method.example).resolve(context)
        automatic = [name for name in automatic if name not in method.example]
    except ClpipeError as error:
        return dict.fromkeys(automatic, str(error))
    return {name: short_text(getattr(values, name)) for name in automatic}


def short_text(value: Any) -> str:
    """A number, or numbers, with four digits.

    >>> short_text(((1.0, 0.123456), (0.0, 2.0)))
    '[[1, 0.1235], [0, 2]]'
    """
    if isinstance(value, tuple):
        return f"[{', '.join(map(short_text, value))}]"
    if value is None:
        return "none"
    plain = not isinstance(value, float) or value.is_integer()
    return value_text(value) if plain else f"{value:.4g}"


def context_for(stage: Stage, settings: Settings) -> Context:
    """What is known where a stage stands in the default chain, or could stand."""
    steps = make_chain(settings).steps
    own = [step.context for step in steps if step.stage is stage]
    alike = [step.context for step in steps if step.stage.reads is stage.reads]
    return [steps[0].context, *alike, *own][-1]


def parameter_rows(method: type[Method]) -> list[tuple[str, ...]]:
    """A row a parameter: name, default, unit, what is allowed, one sentence."""
    rows: list[tuple[str, ...]] = []
    for name, field in method.model_fields.items():
        extra: Any = field.json_schema_extra
        allowed = [type_text(field.annotation)]
        for limit in field.metadata:
            for key, sign in LIMITS.items():
                if (value := getattr(limit, key, None)) is not None:
                    allowed.append(f"{sign} {value:g}")
        default = extra["auto"] or value_text(field.default)
        rows.append((name, default, extra["unit"], ", ".join(allowed), field.description or ""))
    return rows


def stage_record(stage: Stage, context: Context) -> dict[str, Any]:
    """A stage as JSON values, with what automatic parameters come to in a context."""
    keys = ("name", "default", "unit", "allowed", "text")
    return {
        "name": stage.name,
        "summary": stage.summary,
        "reads": stage.reads.label,
        "writes": stage.writes.label,
        "methods": [
            {
                "name": method.method,
                "summary": method.summary,
                "parameters": [dict(zip(keys, row, strict=True)) for row in parameter_rows(method)],
                "automatic": resolved(method, context),
            }
            for method in stage.methods
        ],
    }


def make_and_model(camera: Camera) -> str:
    """What is written on a camera; some makers begin the model with their name."""
    model, make = camera.model, camera.make
    return model if model.startswith(make) else f"{make} {model}"


def camera_row(camera: Camera) -> tuple[str, ...]:
    """A camera in a line: name, make and model, ISOs, where its gain stages begin."""
    stages = ", ".join(f"{stage.iso[0]:g}" for stage in camera.gain_stages)
    low, high = camera.iso_range
    return camera.name, make_and_model(camera), f"{low:g} to {high:g}", stages


def camera_tables(camera: Camera, iso: float | None) -> list[tuple[str, tuple[str, ...], Rows]]:
    """A camera's noise at an ISO, or at all that were measured, as titles, headings and rows.

    Raises:
        RequestError: the camera has not that ISO.
    """
    isos = [iso] if iso is not None else [i for stage in camera.gain_stages for i in stage.iso]
    signal: Rows = []
    paper: Rows = []
    for i in isos:
        record = noise_at(camera, i)
        lines = record["dark_noise"], record["row_noise"], record["column_noise"]
        signal.append(figures(i, *record["signal"].values(), *record["emva1288"].values(), *lines))
        paper.append(figures(i, *record["paper"].values()))
    return [
        (
            f"{make_and_model(camera)}: Var[y] = a*y + b, y = 1 at the white level; EMVA 1288",
            (
                "ISO",
                "a",
                "b",
                "system_gain",
                "read_noise",
                "adc_noise",
                "both",
                "row",
                "column",
            ),
            [("", "", "", "DN/e-", "e-", "DN", "DN", "DN", "DN"), *signal],
        ),
        (
            "The paper's: a = theta/chi, b = theta^2 b' + b'' - theta^2 p0/chi",
            ("ISO", "chi", "theta", "b'", "b''", "p0"),
            paper,
        ),
        (
            "At every ISO",
            ("", "found", "unit"),
            [
                (key, short_text(value) if value is not None else "none known", unit)
                for key, unit in FIXED.items()
                for value in (getattr(camera, key),)
            ],
        ),
    ]


def figures(iso: float, *values: float) -> tuple[str, ...]:
    """An ISO, and numbers with four digits."""
    return (f"{iso:g}", *(f"{value:.4g}" for value in values))


def noise_at(camera: Camera, iso: float) -> dict[str, Any]:
    """Noise at an ISO in all three ways; in the dark, of rows and of columns in DN; JSON values.

    Raises:
        RequestError: the camera has not that ISO.
    """
    unit, model = camera.signal_range, camera.noise(iso)
    return {
        "iso": iso,
        **model.record(),
        "dark_noise": model.b**0.5 * unit,
        "row_noise": camera.row_noise(iso) * unit,
        "column_noise": camera.column_noise(iso) * unit,
    }


def camera_record(camera: Camera, iso: float | None = None) -> dict[str, Any]:
    """A camera as JSON values, with its noise at an ISO or at all that were measured.

    Raises:
        RequestError: the camera has not that ISO.
    """
    isos = [iso] if iso is not None else [i for stage in camera.gain_stages for i in stage.iso]
    return {
        "name": camera.name,
        "make": camera.make,
        "model": camera.model,
        "iso_range": camera.iso_range,
        **{key: getattr(camera, key) for key in FIXED},
        "noise": [noise_at(camera, i) for i in isos],
        "sources": camera.sources,
    }


def stage_row(stage: Stage) -> tuple[str, ...]:
    """A stage in a line: name, what it reads and writes, what it does, its methods."""
    methods = ", ".join(stage.by_name)
    return stage.name, stage.reads.label, stage.writes.label, stage.summary, methods


def check_row(check: Check) -> tuple[str, ...]:
    """A comparison of a kernel with its reference, in a line."""
    return (
        check.stage,
        check.method,
        str(check.cases),
        str(check.samples),
        str(check.differing),
        f"{check.largest:.2g}",
        f"{check.tolerance:.2g}",
        "ok" if check.passed else "FAILED",
    )


CALIBRATION = (
    *("ISO", "frames", "K, DN/e-", "read, DN", "row, DN", "column, DN", "DSNU, e-", "PRNU, %"),
    *("hot", "dead", "pixels used"),
)


def calibration_row(one: Calibration) -> tuple[str, ...]:
    """What was found at an ISO in a line, figures with their standard errors."""

    def told(estimate: Estimate | None, factor: float = 1) -> str:
        if estimate is None:
            return "-"
        return f"{estimate.value * factor:.4g} ± {estimate.error * factor:.1g}"

    return (
        f"{one.iso:g}",
        f"{one.scene_frames} + {one.dark_frames} dark",
        told(one.pooled.gain),
        told(one.read_noise),
        told(one.row_noise),
        told(one.column_noise),
        told(one.dsnu, 1 / one.pooled.gain.value),
        told(one.prnu, 100),
        str(len(one.hot.rows)) if one.hot else "-",
        str(len(one.dead.rows)) if one.dead else "-",
        f"{one.used:.1%}",
    )


def device_rows(devices: Sequence[Found]) -> list[dict[str, Any]]:
    """A row a device with its status: used, usable, or why it is passed over; NumPy comes last."""
    try:
        used: Found | None = choose(None, list(devices))
    except DeviceError:
        used = None
    rows: list[dict[str, Any]] = []
    for device in devices:
        if device is used:
            status = "used by default"
        elif device.problem:
            status = f"passed over: {device.problem}"
        elif device.type == "emulator":
            status = f"passed over: an emulator, slow; --device {device.index}"
        elif used and used.type == "GPU" and device.type != "GPU":
            status = f"passed over: there is a GPU; --device {device.index}"
        else:
            status = f"passed over: an earlier one serves; --device {device.index}"
        rows.append(
            {
                "index": device.index,
                "name": device.name,
                "platform": device.platform,
                "driver": device.driver,
                "type": device.type,
                "compute_units": device.compute_units,
                "memory": f"{device.memory / 2**30:.1f} GiB",
                "lanes": device.lanes,
                "status": status,
            }
        )
    numpy = "slow; --device numpy"
    blank = dict.fromkeys(("driver", "compute_units", "memory", "lanes"), "")
    rows.append(
        {"index": "numpy", "name": "NumPy", "platform": "the references", "type": "CPU"}
        | blank
        | {"status": numpy}
    )
    return rows


def number(value: float, form: str = ".3g") -> str:
    """A measured number; a dash where it could not be told.

    >>> number(0.01234), number(math.nan)
    ('0.0123', '-')
    """
    return "-" if math.isnan(value) else f"{value:{form}}"


def line_text(lines: LineNoise) -> str:
    """What rows or columns share, or what it is below where chance alone could be all of it."""
    if lines.sigma > lines.limit:
        return number(lines.sigma)
    return "-" if math.isnan(lines.limit) else f"< {number(lines.limit)}"


def measure_heading(report: Report) -> str:
    """What was measured, of what, over which pixels, in a line or two."""
    against = report.truth or "their mean"
    what = "samples" if report.kind in ("mosaic", "values") else "pixels (flat, not clipped)"
    lines = [
        f"{len(report.images)} x {report.kind}, {report.width}x{report.height}, against {against}; "
        f"unit: {UNITS[report.kind]}",
        f"{report.share:.1%} of the {what} count",
        *(f"note: {note}" for note in report.notes),
    ]
    return "\n".join(lines)


def measure_tables(report: Report) -> list[tuple[str, Rows]]:
    """The tables of a report: a title and rows of text, the first row being the headings."""
    names = [one.name for one in report.channels]
    laws = ["a", "b"] if any(one.law for one in report.channels) else []
    size: Rows = [("", "samples", "sigma", *laws, "row sigma", "column sigma")]
    shape: Rows = [("", *(f"{k}" for k in range(1, LAGS + 1)), "diagonal 1", "left after 2x2")]
    far: Rows = [("", "skewness", "excess kurtosis", *(f"> {k} sigma" for k in SIGMAS))]
    for one in report.channels:
        found = [""] * len(laws)
        if law := one.law:
            found = [f"{law.a:.4g} ± {law.a_error:.1g}", f"{law.b:.4g} ± {law.b_error:.1g}"]
        lines = line_text(one.rows), line_text(one.columns)
        size.append((one.name, str(one.count), number(one.sigma, ".4g"), *found, *lines))
        table, middle = one.autocorrelation, slice(LAGS + 1, None)
        right = [number(r, ".3f") for r in table[LAGS, middle]]
        down = [number(r, ".3f") for r in table[middle, LAGS]]
        diagonal = number(table[LAGS + 1, LAGS + 1], ".3f")
        shape.append((f"{one.name} right", *right, diagonal, number(one.energy_left, ".3f")))
        shape.append((f"{one.name} down", *down, "", ""))
        tails = one.tails
        moments = number(tails.skewness, ".3f"), number(tails.excess_kurtosis, ".3f")
        far.append((one.name, *moments, *(number(p, ".2g") for p in tails.beyond)))
    far.append(("Gaussian", "0", "0", *(f"{gaussian_beyond(k):.2g}" for k in SIGMAS)))
    sigmas = [dict(zip(one.curve.bins, one.curve.sigma, strict=True)) for one in report.channels]
    curve: Rows = [("intensity", *names)]
    for i in sorted(set().union(*sigmas)):
        middle_of_bin = (report.edges[i] + report.edges[i + 1]) / 2
        values = (f"{s[i]:.4g}" if i in s else "" for s in sigmas)
        curve.append((f"{middle_of_bin:.3f}", *values))
    pairs = [f"{a}-{b}" for a, b in report.correlations]
    across: Rows = [tuple(pairs), tuple(number(r, ".3f") for r in report.correlations.values())]
    return [
        ("noise" + ("; variance = a * intensity + b" if laws else ""), size),
        ("autocorrelation (independent noise: 0; left after 2x2: 0.25)", shape),
        ("correlation between channels", across),
        ("tails of standardised noise", far),
        ("sigma by intensity", curve),
    ]


BATCH_HEADINGS = (
    "images",
    "MP/s",
    "serial s",
    "batch s",
    "of limit",
    "decode",
    "device",
    "encode ms CPU",
    "beyond codec, kernels ms",
    "peak MiB",
)


def batch_row(speed: BatchSpeed) -> tuple[str, ...]:
    """One load of ``clpipe bench --batch``."""
    return (
        f"{speed.images} of {speed.width}x{speed.height}",
        f"{speed.megapixels_per_second:.1f}",
        f"{speed.serial_s:.1f}",
        f"{speed.batch_s:.1f}",
        f"{speed.share_of_limit:.2f}",
        *(f"{ms:.1f}" for ms in speed.cpu_ms.values()),
        f"{speed.overhead_ms:.1f}",
        f"{speed.peak_mib:.0f}",
    )
