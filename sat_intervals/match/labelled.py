"""Final bands of arrays as a dataset."""

from typing import Any

import xarray as xr

from sat_intervals.products import WIDTH, Bands, flag_attributes, interval_bands


def labelled(final: Bands, labels: xr.DataArray, attributes: dict[str, Any]) -> xr.Dataset:
    """Return final bands with the dimensions and coordinates of an array of the same shape."""
    named = {"title": "disparity with intervals", "source": "sat-intervals"}
    dataset = xr.Dataset(coords=labels.coords, attrs=named | attributes)
    for band in interval_bands([name for name in ("sigma", "agreement") if getattr(final, name).size]):
        of_band = {"long_name": band.meaning} | ({"units": band.unit} if band.unit else {})
        dataset[band.name] = xr.DataArray(getattr(final, band.name), dims=labels.dims, attrs=of_band)
    dataset["validity"] = xr.DataArray(final.validity, dims=labels.dims, attrs=flag_attributes())
    dataset["width"] = (dataset["upper"] - dataset["lower"]).assign_attrs(long_name=WIDTH, units="px")
    return dataset
