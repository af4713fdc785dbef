"""Draws a series: the standard's curves, spectrograms and histograms."""

import numpy as np
from scipy.ndimage import uniform_filter

from clpipe.analysis.drawing import (
    BLACK,
    BLUE,
    GREY,
    RED,
    STEPS,
    Panel,
    Series,
    draw_grid,
    page_png,
)
from clpipe.analysis.emva.figures import Figures
from clpipe.analysis.emva.moments import Moments
from clpipe.base.types import Doubles

BOX = 5  # px; the window of the mean that is subtracted before the histogram of PRNU
BINS = 256
PHOTONS, LIGHT = "photons per pixel", "mean above dark, DN"


def emva_png(moments: Moments, figures: Figures, title: str) -> bytes:
    """Return the standard's plots as a PNG, 1600 px wide.

    They are sensitivity, photon transfer, signal-to-noise ratio, linearity,
    spectrograms of rows and of columns, and histograms of DSNU and PRNU.
    """
    of_light = (_sensitivity, _photon_transfer, _signal_to_noise, _linearity)
    panels = [panel(moments, figures) for panel in of_light]
    panels += [_spectra(moments, figures, across) for across in (False, True)]
    panels += [_dsnu(moments, figures), _prnu(moments, figures)]
    return page_png(20, title, lambda figure: draw_grid(figure, panels, 2))


def _fitted(x: Doubles, y: Doubles, figures: Figures, at: float) -> list[Series]:
    """Return points (hollow if they were not fitted) and the saturation."""
    used = figures.fitted
    return [
        Series(x[used], y[used], BLUE, "fitted", "o", ms=4),
        Series(x[~used], y[~used], BLUE, "not fitted", "o", ms=4, mfc="none"),
        Series(at, None, GREY, "saturation", ":", lw=1),
    ]


def _sensitivity(moments: Moments, figures: Figures) -> Panel:
    end, slope = figures.saturation.value, figures.responsivity.value
    points = _fitted(moments.bright.photons, moments.light, figures, end)
    line = Series([0, end], [0, slope * end], BLACK, f"R = {slope:.4g} DN per photon", lw=1.2)
    return Panel([*points, line], "Sensitivity", PHOTONS, LIGHT, xlim=(0, None))


def _photon_transfer(moments: Moments, figures: Figures) -> Panel:
    end, slope = float(moments.light[figures.saturated]), figures.system_gain.value
    points = _fitted(moments.light, moments.noise, figures, end)
    line = Series([0, end], [0, slope * end], BLACK, f"K = {slope:.4g} DN/e⁻", lw=1.2)
    texts = "Photon transfer", LIGHT, "variance above dark, DN²"
    return Panel([*points, line], *texts, xlim=(0, None), ylim=(0, None))


def _signal_to_noise(moments: Moments, figures: Figures) -> Panel:
    """Return SNR over photons with its model, and with DSNU and PRNU."""
    bright, light = moments.bright, moments.light
    seen = (bright.variance > 0) & (light > 0) & (bright.photons <= figures.saturation.value)
    measured = light[seen] / np.sqrt(bright.variance[seen])
    photons = np.geomspace(figures.threshold.value / 2, figures.saturation.value, 200)
    electrons = figures.quantum_efficiency.value * photons
    dark2 = (figures.dark_noise_dn.value / figures.system_gain.value) ** 2
    uneven = figures.dsnu.total.value**2 + (figures.prnu.total.value * electrons) ** 2
    model, least = electrons / np.sqrt(dark2 + electrons), np.sqrt(dark2 + electrons + uneven)
    series = [
        Series(bright.photons[seen], measured, BLUE, "measured, over time", "o", ms=4),
        Series(photons, model, BLACK, f"model; at most {figures.snr_max.value:.4g}", lw=1.2),
        Series(photons, electrons / least, RED, "with DSNU and PRNU", lw=1.2),
        Series(photons, np.sqrt(photons), GREY, "ideal sensor", "--", lw=1),
        Series(figures.threshold.value, None, GREY, "", ":", lw=1),
        Series(figures.saturation.value, None, GREY, "", ":", lw=1),
    ]
    title = f"Signal-to-noise ratio; dynamic range {figures.dynamic_range.value:.4g}"
    wide, high = (photons[0], 2 * photons[-1]), (0.3, 2 * photons[-1] ** 0.5)
    texts = title, PHOTONS, "SNR"
    return Panel(series, *texts, xscale="log", yscale="log", xlim=wide, ylim=high)


def _linearity(moments: Moments, figures: Figures) -> Panel:
    linearity, photons = figures.linearity, moments.bright.photons
    used, least, most = linearity.used, linearity.least.value, linearity.most.value
    label = f"{least:+.3g} to {most:+.3g} %"
    series = [
        Series(photons[used], linearity.deviation[used], BLUE, label, "-o", ms=4, lw=1),
        Series(None, 0, BLACK, lw=1.2),
    ]
    return Panel(series, "Linearity", PHOTONS, "off the line, %")


def _spectra(moments: Moments, figures: Figures, across: bool) -> Panel:
    """Return the roots of the mean power spectra of lines, both in e-."""
    gain = figures.system_gain.value
    unlit, lit = moments.dark_stack, moments.bright_stack
    named = f"with light ({100 * figures.prnu.total.value:.3g} % PRNU)"
    series = []
    for frame, residue, ink, name in (
        (lit.mean_frame - unlit.mean_frame, lit.residue + unlit.residue, RED, named),
        (unlit.mean_frame, unlit.residue, BLUE, "dark"),
    ):
        own = spectrum(frame.T if across else frame) / gain
        series += [
            Series(np.linspace(0, 0.5, len(own)), own, ink, name, lw=1),
            Series(None, residue**0.5 / gain, ink, "temporal noise left", ":", lw=1),
        ]
    title = f"Spectrogram along {'columns' if across else 'rows'}"
    return Panel(series, title, "cycles per pixel", "deviation, e⁻", yscale="log")


def spectrum(frame: Doubles) -> Doubles:
    """Return the root of the mean power spectrum of a frame's rows.

    For white noise, it is the standard deviation at all frequencies.

    >>> noise = np.random.default_rng(0).normal(0, 3, (500, 64))
    >>> bool(abs(spectrum(noise)[1:] - 3).max() < 0.3)
    True
    """
    waves = np.fft.rfft(frame - frame.mean(), axis=1)
    power = np.square(np.abs(waves)).mean(axis=0) / frame.shape[1]
    return np.asarray(np.sqrt(power))


def _dsnu(moments: Moments, figures: Figures) -> Panel:
    frame = moments.dark_stack.mean_frame
    label = "off the mean, e⁻ (temporal noise that is left included)"
    title = f"DSNU, {figures.dsnu.total.value:.3g} e⁻"
    return _histogram((frame - frame.mean()) / figures.system_gain.value, title, label)


def _prnu(moments: Moments, figures: Figures) -> Panel:
    frame = moments.bright_stack.mean_frame - moments.dark_stack.mean_frame
    detail = frame - uniform_filter(frame, BOX, mode="mirror")
    label = f"off the mean of {BOX}x{BOX} pixels, % (temporal noise that is left included)"
    title = f"PRNU, {100 * figures.prnu.total.value:.3g} % without the filter"
    return _histogram(100 * detail / frame.mean(), title, label)


def _histogram(values: Doubles, title: str, label: str) -> Panel:
    """Return a histogram of pixels, and a Gaussian of the same deviation."""
    counts, edges = np.histogram(values, BINS)
    centres, step = (edges[1:] + edges[:-1]) / 2, edges[1] - edges[0]
    sigma = float(values.std())
    series = [Series(edges, counts, BLUE, "pixels", STEPS, alpha=0.6)]
    if sigma:
        gaussian = np.exp(-np.square(centres / sigma) / 2) / (sigma * np.sqrt(2 * np.pi))
        series.append(Series(centres, gaussian * step * values.size, BLACK, "Gaussian", lw=1.2))
    return Panel(series, title, label, "pixels", yscale="log", ylim=(0.5, None))
