"""Smoothing along a row, and runs of its canopy."""

import numpy as np
import pytest

from vinemap.rows.centre_line import _whittaker, centre_line, runs_above, whittaker


def test_runs_above_a_level():
    profile = np.array([0, 0, 1, 1, 1, 0, 0, 1, 1.0])
    assert runs_above(profile, 0.5).tolist() == [[1.5, 4.5], [6.5, 8]]
    assert len(runs_above(profile, 2)) == 0


def test_whittaker_keeps_lines_and_fills_gaps():
    x = np.arange(200) * 0.01
    weights = np.ones(200)
    weights[60:120] = 0
    noisy = np.where(weights > 0, x, 99.0)
    assert np.allclose(whittaker(noisy, weights, cutoff=50), x, atol=1e-6)


def test_whittaker_halves_its_cutoff():
    t = np.arange(4000)
    for wavelength, low, high in ((100, 0.45, 0.55), (400, 0.97, 1.0), (25, 0.0, 0.01)):
        smooth = whittaker(np.sin(2 * np.pi * t / wavelength), np.ones(4000), cutoff=100)
        assert low <= np.abs(smooth[1000:3000]).max() <= high


def test_whittaker_fades_across_gaps_with_a_ridge():
    weights = np.ones(400)
    weights[150:250] = 0
    values = np.where(weights > 0, 1.0, 99.0)
    smooth = _whittaker(values, weights, 20.0, 0.0, 0.02)
    assert abs(smooth[200]) < 0.2
    assert smooth[50] == pytest.approx(1, abs=0.03)


def test_cover_within_the_flanks_moves_no_centre():
    offsets = np.arange(-20, 21) * 0.05
    one_sided = np.where(np.abs(offsets) < 0.62, 0.85 - 0.25 * offsets, 0.0)
    centre = centre_line(np.tile(one_sided, (200, 1)), offsets, reach=0.9, cutoff=50)
    assert np.abs(centre).max() < 0.01
