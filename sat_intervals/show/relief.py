"""Shade heights as the sun would."""

import numpy as np

from sat_intervals.kernels.slopes import rises

_SUN = np.array([-0.5, 0.5, np.sqrt(0.5)])  # direction to the sun (east, north, up): north-west, 45 degrees high
_FLATTENED = 0.3  # factor on heights before slopes: noise of 0.1 m is steep between cells of 0.5 m


def relief(height: np.ndarray, across: float, down: float) -> np.ndarray:
    """Return the hillshade, 0 to 1, NaN where the height is unknown; cells of ``across`` x ``down`` m."""
    east, south = _FLATTENED * rises(height, 1) / across, _FLATTENED * rises(height, 0) / down
    normal = np.stack([-east, south, np.where(np.isfinite(height), 1.0, np.nan)])
    return np.asarray(np.tensordot(_SUN, normal / np.linalg.norm(normal, axis=0), axes=1).clip(0, 1))
