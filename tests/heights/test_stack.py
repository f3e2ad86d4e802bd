"""Shifts of images that are known."""

from contextlib import suppress

import numpy as np
import pytest

from sat_intervals.config import load_config
from sat_intervals.errors import SatIntervalsError
from sat_intervals.match.ground import GroundViews

with suppress(ModuleNotFoundError, SatIntervalsError):  # without shareloc all tests here are skipped
    from scipy.ndimage import gaussian_filter
    from scipy.ndimage import shift as shifted

    from sat_intervals.heights.stack import Sample, Stack, aligned

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
    ground_views = GroundViews(np.zeros((4, 2, 2, 2, 2)), 0.0, 1.0, (1,) * 4, np.zeros((0, 2)), 0.0, 1.0, (96, 96))
    stack = Stack((None,) * 4, ground_views, load_config({"preset": "many"}), None)
    found, correlations = aligned(stack, [Sample(alike, np.ones((96, 96), bool), cell)])
    np.testing.assert_allclose(found, shifts - shifts.mean(axis=0), atol=0.03)
    np.testing.assert_allclose(found.mean(axis=0), 0, atol=1e-9)
    assert (correlations > 0.5).all()
