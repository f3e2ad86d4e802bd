"""Provide the matcher as a method of CARS: ``dense_matching: {method: sat_intervals}``."""

from typing import Any

import numpy as np
import xarray as xr
from cars.applications.dense_matching import dense_matching_algo, dense_matching_wrappers
from cars.applications.dense_matching.methods.pandora_method import PandoraMethod
from cars.core import constants as names
from cars.data_structures import cars_dataset
from json_checker import Or
from pandora.margins import Margins

from sat_intervals.config import Config, load_config, resolved
from sat_intervals.errors import SatIntervalsError

# Bands of `match_arrays` -> names in CARS' triangulation. CARS computes its ambiguity, 1 - confidence, from the first.
_INDICATORS = {
    "confidence": "confidence_from_ambiguity.cars_1",
    "lower": "confidence_from_interval_bounds_inf.cars_3",
    "upper": "confidence_from_interval_bounds_sup.cars_3",
}


class SatIntervals(PandoraMethod, short_name=["sat_intervals"]):  # type: ignore[call-arg, misc]
    """Match the tiles of CARS: disparities with intervals.

    ``conf`` is the section ``dense_matching`` of CARS' configuration; its ``settings`` are those of this package,
    without the search range, over the preset ``paper``, which has CARS' own penalties.
    """

    def __init__(self, conf: dict[str, Any] | None) -> None:
        super(PandoraMethod, self).__init__(conf=conf)
        self.schema = {
            "method": str,
            "settings": dict,
            "performance_map_method": list,
            "perf_ambiguity_threshold": float,
            "generate_ambiguity": bool,
            "loader_conf": Or(dict, None),
            "confidence_filtering": dict,
        }
        # CARS' pipeline expects Pandora's risk maps and its filters of each method; ours provides intervals.
        self.used_config: dict[str, Any] = {
            "method": "sat_intervals",
            "settings": dict((conf or {}).get("settings") or {}),
            "performance_map_method": ["intervals"],
            "perf_ambiguity_threshold": 0.6,
            "generate_ambiguity": True,
            "loader_conf": None,
            "confidence_filtering": {},
        }
        self.method = "sat_intervals"
        self.corr_config: dict[str, Any] = {}
        self.loader = _NoLoader()
        self.margins = Margins(*4 * [resolved(self._config(0, 0)).tiles.support])

    def _config(self, minimum: int, maximum: int) -> Config:
        """Return the settings with a search range."""
        # Confidence is relative to this range: CARS' tiles are matched alone, and percentiles of each would make
        # adjacent ones differ. Calibrations belong to percentiles.
        settings = self.used_config["settings"]
        if "disparity" in settings or None in (settings.get("interval", {}), settings.get("ambiguity", {})):
            raise SatIntervalsError(
                "dense_matching.settings: leave out disparity, and null for interval or ambiguity: CARS provides the "
                "search range and needs intervals and ambiguity"
            )
        given = {"preset": "paper", "rows": "none", **settings, "disparity": {"minimum": minimum, "maximum": maximum}}
        config = load_config(given)
        if config.interval is not None and config.interval.coverage is None:
            ambiguity = {"normalization": "range", **given.get("ambiguity", {})}
            config = load_config(given | {"ambiguity": ambiguity})
        return config

    def run(
        self,
        left_image_object: xr.Dataset,
        right_image_object: xr.Dataset,
        disp_range_grid: Any,
        saving_info: Any = None,
        compute_disparity_masks: bool = False,
        crop_with_range: int | None = None,
        left_overlaps: Any = None,
        margins_to_keep: int = 0,
        texture_bands: list[int] | None = None,
        classif_bands_to_mask: list[Any] | None = None,
        used_band: str = "b0",
    ) -> xr.Dataset:
        """Match a tile by CARS' interface: all pixels over one range, cropped around zero if CARS limits memory."""
        from sat_intervals.prepare.in_memory import match_arrays  # `import cars` must not load numba

        grids = dense_matching_algo.compute_disparity_grid(
            disp_range_grid.data, left_image_object, right_image_object, used_band, False
        )
        minimum, maximum, is_cropped = _search_range(grids[0], grids[1], crop_with_range)
        left = _pixels(left_image_object, used_band, classif_bands_to_mask)
        matched = match_arrays(left, _pixels(right_image_object, used_band), self._config(minimum, maximum))
        result: xr.Dataset = dense_matching_wrappers.create_disp_dataset(
            _as_pandora(matched, left_image_object),
            *(_of_band(tile, used_band) for tile in (left_image_object, right_image_object)),
            compute_disparity_masks=compute_disparity_masks,
            disp_min_grid=np.maximum(grids[0], minimum),
            disp_max_grid=np.minimum(grids[1], maximum),
            cropped_range=(grids[0] < minimum) | (grids[1] > maximum) if is_cropped else None,
            margins_to_keep=margins_to_keep,
            texture_bands=texture_bands,
        )
        cars_dataset.fill_dataset(
            result,
            saving_info=saving_info,
            window=cars_dataset.get_window_dataset(left_image_object),
            profile=cars_dataset.get_profile_rasterio(left_image_object),
            attributes={names.CROPPED_DISPARITY_RANGE: is_cropped},
            overlaps=left_overlaps,
        )
        return result


class _NoLoader:
    """Replace the loader of Pandora's configuration, which CARS calls."""

    def get_conf(self) -> dict[str, Any]:
        return {}

    def check_conf(self, conf: dict[str, Any], *images: Any) -> dict[str, Any]:
        return conf


def _search_range(lowest: np.ndarray, highest: np.ndarray, most: int | None) -> tuple[int, int, bool]:
    """Return the range over all pixels, and whether it was cropped around zero to ``most`` disparities."""
    minimum, maximum = int(np.floor(lowest.min())), int(np.ceil(highest.max()))
    share = 1.0 if most is None else min(1.0, most / max(1, maximum - minimum))
    return round(share * minimum), round(share * maximum), share < 1


def _of_band(tile: xr.Dataset, band: str) -> xr.Dataset:
    """Return the tile with the mask of one band."""
    return tile.assign({names.EPI_MSK: tile[names.EPI_MSK].sel({names.BAND_IM: band}, drop=True)})


def _pixels(tile: xr.Dataset, band: str, classes: list[Any] | None = None) -> np.ma.MaskedArray:
    """Return the pixels of one band, masked by the tile's mask and by classes."""
    masked = tile[names.EPI_MSK].sel({names.BAND_IM: band}).values != 0
    if classes and names.EPI_CLASSIFICATION in tile:
        masked |= (tile[names.EPI_CLASSIFICATION].sel(band_classif=classes).values != 0).any(axis=0)
    return np.ma.masked_array(tile[names.EPI_IMAGE].sel({names.BAND_IM: band}).values, masked)


def _as_pandora(matched: xr.Dataset, tile: xr.Dataset) -> xr.Dataset:
    """Return the dataset that Pandora would return; its validity bits are those of `products`."""
    place = (names.ROW, names.COL)
    layers = np.stack([matched[band].values for band in _INDICATORS], axis=-1)
    return xr.Dataset(
        {
            "disparity_map": (place, matched["disparity"].values),
            "validity_mask": (place, matched["validity"].values.astype(np.int64)),
            "confidence_measure": ((*place, "indicator"), layers),
        },
        coords={name: tile.coords[name] for name in place} | {"indicator": list(_INDICATORS.values())},
    )
