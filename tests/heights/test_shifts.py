"""Shifts of images that are known."""

from contextlib import suppress

import numpy as np
import pytest

from sat_intervals.errors import SatIntervalsError
from sat_intervals.match.ground import GroundViews

with suppress(ModuleNotFoundError, SatIntervalsError):  # without shareloc all tests here are skipped
    from scipy.ndimage import gaussian_filter
    from scipy.ndimage import shift as shifted

    from sat_intervals.heights.shifts import Sample, aligned, correlations, tilted

pytestmark = pytest.mark.peer("shareloc")


def test_aligned__finds_shifts_of_images_of_which_one_is_turned():
    random = np.random.default_rng(2)
    ground = gaussian_filter(random.normal(0, 1, (96, 96)), 1.5) * 4
    shifts = np.array([[0.4, -0.7], [-0.3, 0.2], [0.5, 0.9], [-0.6, -0.4]])
    cell = np.stack([np.eye(2)] * 3 + [np.array([[0.0, 1.0], [-1.0, 0.0]])])
    # what a cell shows is `shift` pixels away from where it should be
    moves = np.einsum("nij,nj->ni", np.linalg.inv(cell), shifts)
    alike = np.stack([shifted(ground, move, order=3, mode="reflect") for move in moves]).astype(np.float32)
    alike += random.normal(0, 0.02, alike.shape).astype(np.float32)
    alike[:, :4] = alike[:, -4:] = alike[:, :, :4] = alike[:, :, -4:] = np.nan
    samples = [Sample(np.zeros(2), alike, np.ones((96, 96), bool), cell)]
    found, alike = aligned(samples, (1,) * 4), correlations(samples)
    np.testing.assert_allclose(found, shifts - shifts.mean(axis=0), atol=0.03)
    np.testing.assert_allclose(found.mean(axis=0), 0, atol=1e-9)
    assert (alike > 0.5).all()


@pytest.mark.parametrize("shifts", [[[0.3, 0.2], [-0.3, -0.2], [0, 0], [0, 0], [0, 0]], [[0, 0], [0.1, 0], [0, 0]]])
def test_tilted__finds_the_plane_of_an_image_and_leaves_shifts_of_others(shifts):
    random, count = np.random.default_rng(3), len(shifts)
    slope = np.array([[1.2, -0.8], [0.6, 1.0]])
    samples = []
    for place in np.stack(np.meshgrid([-0.4, 0, 0.4], [-0.4, 0, 0.4]), axis=-1).reshape(-1, 2):
        ground = gaussian_filter(random.normal(0, 1, (96, 96)), 1.5) * 4
        moves = [*shifts[:-1], place @ slope]
        alike = np.stack([shifted(ground, move, order=3, mode="reflect") for move in moves]).astype(np.float32)
        samples.append(Sample(place, alike[:, 4:-4, 4:-4], np.ones((88, 88), bool), np.stack([np.eye(2)] * count)))
    ground_views = GroundViews(
        np.zeros((count, 2, 2, 2, 2)), 0.0, 1.0, (1,) * count, np.zeros((0, 2)), 0.0, 1.0, (96, 96)
    )
    fits = tilted(samples, aligned(samples, (1,) * count), (1,) * count)
    others = fits.slope[:-1]
    np.testing.assert_allclose(others - others[0], 0, atol=0.02)
    np.testing.assert_allclose(fits.slope[-1] - others[0], slope, atol=0.1)
    np.testing.assert_allclose(fits.shift - fits.shift[-1], shifts, atol=0.06)
    np.testing.assert_allclose(fits.slope.mean(axis=0), 0, atol=1e-9)
    assert (fits.left < 0.15).all()
    # positions get what was found
    corner = ground_views.tilted(fits.slope).places[-1, 0, 0, 0]
    np.testing.assert_allclose(corner, -fits.slope[-1].sum(axis=0) / 2)
    # few blocks make planes of noise
    few = tilted(samples[:4], aligned(samples[:4], (1,) * count), (1,) * count)
    assert not few.slope.any()
