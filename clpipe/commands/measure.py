"""``clpipe measure``: measure the noise of images, as tables, JSON or a plot."""

import math
from collections.abc import Sequence
from pathlib import Path

import click

from clpipe.analysis.bursts import bursts_in
from clpipe.analysis.finished import finished_rows
from clpipe.analysis.measure import measure as measure_images
from clpipe.analysis.pictures import load_picture
from clpipe.analysis.pooling import pool_by_iso
from clpipe.analysis.report import UNITS, NoiseReport, json_value
from clpipe.analysis.snr import MIN_SAMPLES, SnrStep, snr_curve
from clpipe.analysis.spatial import LAGS, LineNoise
from clpipe.analysis.statistics import SIGMAS, gaussian_beyond
from clpipe.analysis.temporal import measure_clip
from clpipe.base.errors import RequestError
from clpipe.base.extras import require
from clpipe.base.files import check_suffix
from clpipe.commands.options import EXISTING, Command, OutputPath, json_option
from clpipe.commands.printing import Rows, number, show, show_json
from clpipe.images.video_reading import VIDEO_SUFFIXES
from clpipe.outputs.noise_areas import FLAT, HALVED, PICTURE
from clpipe.reference.cfa import PATTERNS, Pattern
from clpipe.stage import Kind
from clpipe.stages.picture_noise import UNKNOWN


@click.command("measure", cls=Command)
@click.argument("images", nargs=-1, required=True, type=EXISTING, metavar="IMAGE...")
@click.option("--truth", type=EXISTING, metavar="FILE", help="The image without noise.")
@click.option(
    "--pattern",
    default="RGGB",
    show_default=True,
    type=click.Choice(PATTERNS),
    help="The CFA pattern of mosaics whose files do not contain it.",
)
@click.option(
    "--plot",
    type=OutputPath(path_type=Path),
    metavar="FILE.png",
    help="Plot noise by intensity, autocorrelation and tails.",
)
@click.option(
    "--snr",
    is_flag=True,
    help="Print the signal-to-noise ratio in steps of half a stop instead, like a data sheet.",
)
@json_option
def measure(
    images: tuple[Path, ...],
    truth: Path | None,
    pattern: Pattern,
    plot: Path | None,
    snr: bool,
    as_json: bool,
) -> None:
    """Measure the noise of images: its strength, correlation and distribution.

    IMAGE is a kept EXR of any stage, a mosaic, or a finished picture (JPEG, PNG, TIFF). Noise is
    the difference from --truth, or from the mean of two or more frames of one scene. Name several
    bursts (NAME.frame0.png and so on), or directories of bursts, to get one report per ISO.

    IMAGE may also be one clip of a static scene (MP4, MKV and others). Its report has the
    correlation of noise with that of later frames.

    \b
    clpipe run render.exr -o noisy --iso 3200 --until quantize
    clpipe run render.exr -o clean --iso 3200 --until quantize --skip noise
    clpipe measure noisy/render.exr --truth clean/render.exr
    """
    if plot is not None:
        check_suffix("--plot", plot, ".png")
        require("--plot", "calibrate", "matplotlib")
    clip = next((path for path in images if path.suffix.lower() in VIDEO_SUFFIXES), None)
    if clip and (len(images) > 1 or truth or snr):
        raise RequestError(
            f"{clip}: a clip is measured against the mean of its frames; name one clip, without "
            "--truth and --snr"
        )
    bursts = bursts_in(images)
    if truth is not None and len(bursts) > 1:
        raise RequestError(
            f"--truth: found {len(bursts)} bursts, but one ground truth belongs to one "
            "scene; name the images of one scene"
        )
    clean = load_picture(truth, pattern) if truth else None
    if snr:
        if plot is not None or len(bursts) > 1:
            raise RequestError(
                "--snr: the result is a table of one scene; name the images of one scene, without "
                "--plot"
            )
        show_snr(snr_curve([load_picture(p, pattern) for p in bursts[0]], clean), as_json)
        return
    reports = pool_by_iso(
        [measure_clip(clip)]
        if clip
        else [measure_images([load_picture(p, pattern) for p in burst], clean) for burst in bursts]
    )
    if plot is not None and len(reports) > 1:
        raise RequestError(
            f"--plot: found {len(reports)} ISOs, but a plot shows one; name the images of one ISO"
        )
    if plot is not None:
        from clpipe.analysis.plot import draw

        draw(reports[0], plot)
    if as_json:
        several = {"by_iso": {iso_text(report): report.record() for report in reports}}
        show_json(reports[0].record() if len(reports) == 1 else several)
        return
    for report in reports:
        click.echo(("\n\n" if report is not reports[0] else "") + measure_heading(report))
        for title, (headings, *rows) in measure_tables(report):
            click.echo(f"\n{title}")
            show(headings, rows, left=0 if headings[0] else 1)


def show_snr(curve: Sequence[SnrStep], as_json: bool) -> None:
    """Print a curve of signal-to-noise ratios.

    Raises:
        RequestError: the curve is empty.
    """
    if not curve:
        raise RequestError(
            f"--snr: no half stop of brightness has {MIN_SAMPLES} usable samples; name more or "
            "larger images"
        )
    if as_json:
        show_json({"snr": json_value(curve)})
        return
    rows = [
        (f"{x.intensity:.4g}", f"{x.stops:.1f}", f"{x.decibels:.1f}", str(x.samples)) for x in curve
    ]
    show(["intensity", "stops below", "SNR, dB", "samples"], rows, left=0)


def iso_text(report: NoiseReport) -> str:
    """Return the ISO of a report as text."""
    return UNKNOWN if report.iso is None else f"{report.iso:g}"


def line_text(lines: LineNoise) -> str:
    """Return the sigma of row or column noise, or its upper limit if it is not significant."""
    if lines.sigma > lines.limit:
        return number(lines.sigma)
    return "-" if math.isnan(lines.limit) else f"< {number(lines.limit)}"


def measure_heading(report: NoiseReport) -> str:
    """Return the heading of a report: the images, the unit, and the pixels that were used."""
    against = report.truth or ("their mean" if report.bursts == 1 else "the mean of their burst")
    of = f" in {report.bursts} bursts" if report.bursts > 1 else ""
    at = f", ISO {report.iso:g}" if report.iso else ""
    unit_text = "samples" if report.kind in ("mosaic", "values") else "pixels (flat, not clipped)"
    count = report.frames or len(report.images)
    ratio = f"{report.edges_over_flat:.2f} times"
    edges = f"luma noise is {ratio} as strong at edges (steepest tenth) as in the flattest quarter"
    lines = [
        f"{count} x {report.kind}{of}, {report.width}x{report.height}{at}, against {against}; "
        f"unit: {UNITS[report.kind]}",
        f"{report.share_used:.1%} of the {unit_text} are used; sigma (all) uses every one",
        *([] if math.isnan(report.edges_over_flat) else [edges]),
        *(f"note: {note}" for note in report.notes),
    ]
    return "\n".join(lines)


def measure_tables(report: NoiseReport) -> list[tuple[str, Rows]]:
    """Return the tables of a report: titles and rows of text. The first row holds the headings."""
    names = [channel.name for channel in report.channels]
    laws = ["a", "b"] if any(channel.law for channel in report.channels) else []
    which = "not clipped" if report.kind in ("mosaic", "values") else "flat"
    sigmas_of = f"sigma ({which}, {report.share_used:.0%})", "sigma (all, 100%)"
    noise_rows: Rows = [("", "samples", *sigmas_of, *laws, "row sigma", "column sigma")]
    correlation_rows: Rows = [
        ("", *(f"{k}" for k in range(1, LAGS + 1)), "diagonal 1", "left after 2x2")
    ]
    tail_rows: Rows = [("", "skewness", "excess kurtosis", *(f"> {k} sigma" for k in SIGMAS))]
    for channel in report.channels:
        fit = [""] * len(laws)
        if law := channel.law:
            fit = [f"{law.a:.4g} ± {law.a_error:.1g}", f"{law.b:.4g} ± {law.b_error:.1g}"]
        lines = line_text(channel.row), line_text(channel.column)
        sizes = number(channel.sigma, ".4g"), number(channel.sigma_picture, ".4g")
        noise_rows.append((channel.name, str(channel.samples), *sizes, *fit, *lines))
        table, middle = channel.autocorrelation, slice(LAGS + 1, None)
        right = [number(r, ".3f") for r in table[LAGS, middle]]
        down = [number(r, ".3f") for r in table[middle, LAGS]]
        diagonal = number(table[LAGS + 1, LAGS + 1], ".3f")
        correlation_rows.append(
            (f"{channel.name} right", *right, diagonal, number(channel.energy_left_2x2, ".3f"))
        )
        correlation_rows.append((f"{channel.name} down", *down, "", ""))
        tails = channel.tails
        moments = number(tails.skewness, ".3f"), number(tails.excess_kurtosis, ".3f")
        tail_rows.append((channel.name, *moments, *(number(p, ".2g") for p in tails.beyond)))
    tail_rows.append(("Gaussian", "0", "0", *(f"{gaussian_beyond(k):.2g}" for k in SIGMAS)))
    sigmas = [
        dict(zip(channel.intensity.bins, channel.intensity.sigma, strict=True))
        for channel in report.channels
    ]
    intensity_rows: Rows = [("intensity", *names)]
    for i in sorted(set().union(*sigmas)):
        middle_of_bin = (report.edges[i] + report.edges[i + 1]) / 2
        values = (f"{s[i]:.4g}" if i in s else "" for s in sigmas)
        intensity_rows.append((f"{middle_of_bin:.3f}", *values))
    finished_table: Rows = [("", "here", "real cameras")]
    finished_table += [(t, f"{v:.2f}", real) for t, v, real in finished_rows(report.finished)]
    pairs = report.correlation
    channel_correlations: Rows = [tuple(pairs), tuple(number(r, ".3f") for r in pairs.values())]
    return [
        ("noise" + ("; variance = a * intensity + b" if laws else ""), noise_rows),
        ("autocorrelation (independent noise: 0; left after 2x2: 0.25)", correlation_rows),
        *([(TEMPORAL, temporal_rows(report))] if report.temporal_correlation else []),
        *([("correlation between channels", channel_correlations)] if pairs else []),
        *([("covariance of the channels", covariance_rows(report))] if report.covariance else []),
        ("tails of standardised noise", tail_rows),
        ("sigma by intensity", intensity_rows),
        *([(FINISHED, finished_table)] if len(finished_table) > 1 else []),
    ]


FINISHED = "finished picture, flat areas, by luma of 255"
TEMPORAL = "correlation with later frames, flat areas (independent noise: 0)"
AREA_NAMES = {FLAT: "flat areas", PICTURE: "all", HALVED: "all, after 2x2"}


def covariance_rows(report: NoiseReport) -> Rows:
    """Return the covariances of red, green and blue, one row for each set of pixels."""
    first, *_ = report.covariance.values()
    places = [(i, j) for i in range(len(first)) for j in range(i, len(first))]
    names = Kind.RGB.channels
    rows: Rows = [("", *(f"{names[i]}-{names[j]}" for i, j in places))]
    for where, table in report.covariance.items():
        rows.append((AREA_NAMES[where], *(number(float(table[at]), ".4g") for at in places)))
    return rows


def temporal_rows(report: NoiseReport) -> Rows:
    """Return the correlations with later frames, one row for each channel."""
    lags = len(next(iter(report.temporal_correlation.values())))
    rows: Rows = [("frames later", *map(str, range(1, lags + 1)))]
    for name, values in report.temporal_correlation.items():
        rows.append((name, *(number(float(value), ".3f") for value in values)))
    return rows
