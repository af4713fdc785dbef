"""Statistics of noise with a known distribution."""

from math import erfc, sqrt

import numpy as np
import pytest

from clpipe.analysis.intensity import (
    bin_edges,
    fit_variance,
    noise_by_intensity,
    pool_curves,
    select_unclipped,
)
from clpipe.analysis.spatial import LAGS, autocorrelation, count_pairs, energy_left, line_noise
from clpipe.analysis.statistics import SIGMAS, channel_statistics, correlation, tails
from clpipe.outputs.noise_areas import select_flat

RANDOM = np.random.default_rng(5)
START = RANDOM.bit_generator.state
SIZE = (700, 800)
ALL = np.ones(SIZE, bool)
RAMP = np.tile(np.linspace(0, 1, SIZE[1], dtype=np.float32), (SIZE[0], 1))
EDGES = bin_edges(0, 1, linear=True)


@pytest.fixture(autouse=True)
def same_numbers_in_any_order_of_tests():
    RANDOM.bit_generator.state = START


def normal(*shape):
    return RANDOM.standard_normal(shape, np.float32)


def box(noise):
    """The mean of 3x3 pixels, borders wrapped: triangles for an autocorrelation."""
    shifts = [(y, x) for y in (-1, 0, 1) for x in (-1, 0, 1)]
    return np.mean([np.roll(noise, s, (-2, -1)) for s in shifts], axis=0, dtype=np.float32) * 3


def test_white_noise_is_white():
    white = normal(1, *SIZE)
    table = autocorrelation(white, count_pairs(ALL))
    assert table[LAGS, LAGS] == pytest.approx(1)
    table[LAGS, LAGS] = 0
    assert np.abs(table).max() < 5 / sqrt(white.size)
    assert energy_left(white, ALL) == pytest.approx(0.25, abs=0.002)
    found = tails(white, ALL)
    assert abs(found.skewness) < 4 * sqrt(6 / white.size)
    assert abs(found.excess_kurtosis) < 4 * sqrt(24 / white.size)
    for k, share in zip(SIGMAS, found.beyond, strict=True):
        expected = white.size * erfc(k / sqrt(2))
        assert abs(share * white.size - expected) < 4 * sqrt(expected) + 1


@pytest.mark.parametrize("share", [1.0, 0.7])
def test_blurred_noise_has_the_autocorrelation_of_its_kernel(share):
    # A 3x3 box: 1, 2/3, 1/3, 0 in each direction, the product of both on a diagonal.
    mask = RANDOM.random(SIZE) < share
    blurred = np.where(mask, box(normal(1, *SIZE)), 0)
    table = autocorrelation(blurred, count_pairs(mask))
    line = np.zeros(LAGS + 1)
    line[:3] = 1, 2 / 3, 1 / 3
    expected = np.concatenate([line[:0:-1], line])
    assert np.abs(table - np.outer(expected, expected)).max() < 0.012
    if share == 1:
        # The mean of the 16 correlations in a block of 2x2.
        assert energy_left(blurred, mask) == pytest.approx((1 + 2 / 3) ** 2 / 4, abs=0.005)


def test_a_lag_right_is_not_a_lag_down():
    noise = normal(1, *SIZE)
    table = autocorrelation(noise + np.roll(noise, (2, 3), (1, 2)), count_pairs(ALL))
    assert table[LAGS + 2, LAGS + 3] == pytest.approx(0.5, abs=0.01)
    assert table[LAGS - 2, LAGS - 3] == pytest.approx(0.5, abs=0.01)
    assert abs(table[LAGS + 2, LAGS - 3]) < 0.01
    assert abs(table[LAGS + 3, LAGS + 2]) < 0.01


def test_the_law_of_a_sensor_is_recovered():
    a, b = 2e-3, 4e-5
    noise = normal(3, *SIZE) * np.sqrt(a * RAMP + b) + 0.01 * RAMP**2  # and a tone shift
    curve, without, standard = noise_by_intensity(RAMP, noise, ALL, EDGES)
    law = fit_variance(curve)
    assert law.a == pytest.approx(a, rel=0.01)
    assert law.b == pytest.approx(b, rel=0.02)
    assert abs(law.a - a) < 3 * law.a_error < 0.02 * a
    assert abs(law.b - b) < 3 * law.b_error < 0.05 * b
    assert curve.sigma == pytest.approx(np.sqrt(a * curve.mean + b), rel=0.03)
    assert curve.shift == pytest.approx(0.01 * curve.mean**2, abs=4e-4)
    assert curve.samples.sum() == noise.size
    assert abs(tails(standard, ALL).excess_kurtosis) < 0.02
    assert without.std() == pytest.approx(sqrt(a / 2 + b), rel=0.01)


def test_standard_errors_are_honest():
    a, b = 2e-3, 4e-5
    ramp = RAMP[:100, ::4]
    mask = np.ones(ramp.shape, bool)
    off = []
    for blur in (lambda x: x, box):
        for _ in range(40):
            noise = blur(normal(1, *ramp.shape)) * np.sqrt(a * ramp + b)
            curve, without, standard = noise_by_intensity(ramp, noise, mask, EDGES)
            law = channel_statistics(
                "R", curve, without, standard, mask, count_pairs(mask), fits_line=True
            ).law
            off += [(law.a - a) / law.a_error, (law.b - b) / law.b_error]
        assert 0.7 < np.std(off) < 1.35
        assert abs(np.mean(off)) < 0.4
        off.clear()


def test_rows_and_columns():
    rows, columns = normal(2, SIZE[0], 1) * 0.2, normal(SIZE[1]) * 0.05
    noise = normal(2, *SIZE) + rows + columns
    mask = RANDOM.random(SIZE) < 0.8
    masked = np.where(mask, noise, 0)
    assert line_noise(masked, mask).sigma == pytest.approx(rows.std(), rel=0.02)
    turned = line_noise(masked.swapaxes(1, 2), mask.T)
    assert turned.sigma == pytest.approx(columns.std(), rel=0.05)
    assert turned.limit < 0.03


def test_smeared_noise_is_no_row_noise():
    blurred = box(normal(1, *SIZE))
    found = line_noise(blurred, ALL)
    assert found.sigma < found.limit
    # Were neighbours taken for independent, it would be seen as this much.
    assert found.limit < sqrt(8 / SIZE[1])


def test_correlated_channels():
    one, other = normal(1, *SIZE), normal(1, *SIZE)
    assert correlation(one, 0.6 * one + 0.8 * other, ALL) == pytest.approx(0.6, abs=0.005)
    assert abs(correlation(one, other, ALL)) < 0.01
    assert np.isnan(correlation(one, 0 * other, ALL))


def test_clipped_intensities_do_not_count():
    noise = normal(1, *SIZE) * np.float32(0.05)
    seen = RAMP + noise
    clipped = (seen <= 0) | (seen >= 1)
    mask = select_unclipped(RAMP, clipped, EDGES, ALL)
    assert not mask[:, RAMP[0] < 0.1].any()
    assert not mask[:, RAMP[0] > 0.9].any()
    assert mask[:, (RAMP[0] > 0.2) & (RAMP[0] < 0.8)].mean() > 0.999
    kept = (seen.clip(0, 1) - RAMP)[:, mask]
    assert kept.std() == pytest.approx(0.05, rel=0.01)


def test_flat_mask():
    truth = np.zeros((100, 200, 3), np.float32)
    truth[:, 100:] = 0.5
    truth += np.linspace(0, 0.05, 200, dtype=np.float32)[:, None]
    found = select_flat(truth, normal(1, 100, 200, 3) * np.float32(0.01), np.ones((100, 200), bool))
    assert not found[:, 97:103].any()
    assert found[:, :95].all() and found[:, 105:].all()
    # Without noise the flattest quarter counts.
    steep = np.linspace(0, 1, 200, dtype=np.float32) ** 2 * np.ones((100, 3, 1), np.float32)
    steep = np.ascontiguousarray(steep.transpose(0, 2, 1))
    found = select_flat(steep, np.zeros((1, 100, 200, 3), np.float32), np.ones((100, 200), bool))
    assert 0.2 < found.mean() < 0.3
    assert found[:, :45].all()


def test_pooled_curves():
    noise = normal(1, *SIZE) * np.sqrt(1e-3 * RAMP + 1e-5)
    whole, *_ = noise_by_intensity(RAMP, noise, ALL, EDGES)
    halves = [noise_by_intensity(RAMP[i::2], noise[:, i::2], ALL[i::2], EDGES)[0] for i in (0, 1)]
    both = pool_curves(halves)
    assert both.samples.tolist() == whole.samples.tolist()
    assert both.mean == pytest.approx(whole.mean)
    assert both.sigma == pytest.approx(whole.sigma, rel=2e-3)
