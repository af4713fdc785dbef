"""Pooling: one noise report for several bursts of different scenes or views at one ISO.

Variances and correlations are means over all samples. The laws of raws are means weighted by the
inverse of their squared errors, because each burst is a separate estimate.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clpipe.analysis.calibration.line_fit import Estimate, weighted
from clpipe.analysis.intensity import NoiseCurve, VarianceLaw, bin_edges, bin_of, pool_curves
from clpipe.analysis.report import NoiseReport
from clpipe.analysis.spatial import LineNoise
from clpipe.analysis.statistics import Channel, Tails
from clpipe.base.errors import RequestError
from clpipe.base.types import Doubles


def pool_by_iso(reports: Sequence[NoiseReport]) -> list[NoiseReport]:
    """Return one report for each ISO, in ascending order, and one for images of unknown ISO.

    Raises:
        RequestError: the reports have images of several kinds.
    """
    for other in reports:
        if other.kind != reports[0].kind:
            raise RequestError(
                f"{other.images[0]} is {other.kind}, but {reports[0].images[0]} is "
                f"{reports[0].kind}; measure them separately"
            )
    isos = sorted({report.iso for report in reports}, key=lambda iso: iso or 0)
    return [pool([report for report in reports if report.iso == iso]) for iso in isos]


def pool(reports: Sequence[NoiseReport]) -> NoiseReport:
    """Return one report from several of one kind, with the size of the first."""
    first = reports[0]
    if len(reports) == 1:
        return first
    low, high = (end(report.edges[k] for report in reports) for end, k in ((min, 0), (max, -1)))
    edges = bin_edges(low, high, first.kind != "display")
    sizes = np.array([len(r.images) * r.width * r.height for r in reports], float)
    used = sizes * [r.share_used for r in reports]
    channels = (
        pool_channel(each, edges) for each in zip(*(r.channels for r in reports), strict=True)
    )
    pairs = {pair: [r.correlation[pair] for r in reports] for pair in first.correlation}
    tables = {where: [r.covariance[where] for r in reports] for where in first.covariance}
    finished = {name: [r.finished[name] for r in reports] for name in first.finished}
    return replace(
        first,
        images=tuple(image for report in reports for image in report.images),
        share_used=float(used.sum() / sizes.sum()),
        edges=edges,
        channels=tuple(channels),
        correlation={pair: float(mean(values, used)) for pair, values in pairs.items()},
        covariance={
            where: mean(values, used if where == "flat" else sizes)
            for where, values in tables.items()
        },
        notes=tuple(dict.fromkeys(note for report in reports for note in report.notes)),
        bursts=len(reports),
        edges_over_flat=float(mean([r.edges_over_flat for r in reports], sizes)),
        finished={name: float(mean(values, sizes)) for name, values in finished.items()},
    )


def pool_channel(channels: Sequence[Channel], edges: Doubles) -> Channel:
    """Return one channel from several bursts, with intensity bins between these edges."""
    count = np.array([one.samples for one in channels], float)
    sizes = np.array([one.size for one in channels], float)
    laws = [one.law for one in channels if one.law]
    whole = [one.intensity_picture for one in channels if one.intensity_picture]
    return Channel(
        name=channels[0].name,
        samples=int(count.sum()),
        sigma=root_mean_square([one.sigma for one in channels], count),
        intensity=pool_curves([rebinned(one.intensity, edges) for one in channels]),
        law=pool_laws(laws) if len(laws) == len(channels) else None,
        row=pool_lines([one.row for one in channels], count),
        column=pool_lines([one.column for one in channels], count),
        autocorrelation=mean([one.autocorrelation for one in channels], count),
        energy_left_2x2=float(mean([one.energy_left_2x2 for one in channels], count)),
        tails=pool_tails([one.tails for one in channels], count),
        sigma_picture=root_mean_square([one.sigma_picture for one in channels], sizes),
        intensity_picture=pool_curves([rebinned(each, edges) for each in whole]) if whole else None,
        size=int(sizes.sum()),
    )


def mean(values: Sequence[Any], weights: Doubles) -> NDArray[np.float64]:
    """Return the weighted mean of numbers or arrays without NaN; NaN if all are NaN."""
    stack = np.array(values, float)
    known = np.isfinite(stack)
    each = weights.reshape(-1, *[1] * (stack.ndim - 1)) * known
    total = each.sum(0)
    sums = (np.where(known, stack, 0) * each).sum(0)
    return np.asarray(np.divide(sums, total, out=np.full_like(sums, np.nan), where=total > 0))


def root_mean_square(sigmas: Sequence[float], weights: Doubles) -> float:
    """Return the sigma of all samples taken together."""
    return float(np.sqrt(mean([sigma**2 for sigma in sigmas], weights)))


def rebinned(curve: NoiseCurve, edges: Doubles) -> NoiseCurve:
    """Return a curve whose bins are numbered by other edges, according to their means."""
    return replace(curve, bins=bin_of(curve.mean.astype(np.float32), edges))


def pool_laws(laws: Sequence[VarianceLaw]) -> VarianceLaw:
    """Return the mean of several laws, weighted by the inverse of their squared errors."""
    a = weighted([Estimate(law.a, law.a_error) for law in laws])
    b = weighted([Estimate(law.b, law.b_error) for law in laws])
    return VarianceLaw(a.value, b.value, a.error, b.error)


def pool_lines(lines: Sequence[LineNoise], count: Doubles) -> LineNoise:
    """Return the row noise of several bursts; the limits assume independent variances."""
    share = count / count.sum()
    limits = np.array([one.limit for one in lines]) ** 2 * share
    sigma = root_mean_square([one.sigma for one in lines], count)
    return LineNoise(sigma, float(np.sqrt(np.sqrt((limits**2).sum()))))


def pool_tails(tails: Sequence[Tails], count: Doubles) -> Tails:
    """Return the distribution of all samples taken together."""
    beyond = mean([one.beyond for one in tails], count)
    return Tails(
        skewness=float(mean([one.skewness for one in tails], count)),
        excess_kurtosis=float(mean([one.excess_kurtosis for one in tails], count)),
        beyond=tuple(map(float, beyond)),
        histogram=np.sum([one.histogram for one in tails], axis=0),
    )
