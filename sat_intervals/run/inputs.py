"""Describe the inputs of a run (images, masks, MC-CNN weights), and compare them with those of an earlier run."""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict
from importlib.metadata import version
from typing import Any

import numpy as np

from sat_intervals.config import Config, Mccnn, load_config
from sat_intervals.config.weights import weights_file
from sat_intervals.errors import ChangedInputError
from sat_intervals.match.local_ranges import LocalRanges
from sat_intervals.raster import Image, check_as_opened, pixel_files, survey
from sat_intervals.raster.beside import SIDECARS, is_read
from sat_intervals.raster.identity import identity
from sat_intervals.run.local_ranges import read_ranges
from sat_intervals.store.manifest import differences
from sat_intervals.tiling import Window


def describe_inputs(
    left: Image, right: Image, config: Config, before: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Return the inputs for run.json and the manifest, and the `identity` of each file by name.

    ``before`` are the inputs of an earlier manifest: unchanged files are not hashed again.
    """
    known, files = _known(before), {}

    def identified(name: str) -> dict[str, Any]:
        if name not in files:
            files[name] = identity(name, known)
        return files[name]

    inputs = {"left": _described(left, identified), "right": _described(right, identified)}
    if isinstance(config.cost, Mccnn):
        inputs["weights"] = _weights_identity(config.cost)
    return inputs, files


def _known(inputs: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Return the identities of files in the inputs of a manifest, by path."""
    ways = [one for both in inputs.values() for one in (both, both.get("mask")) if one]
    described = [file for one in ways for file in (one, *one.get("files", ()))]
    return {file["path"]: file for file in described if "sha256" in file}


def _described(image: Image, identified: Callable[[str], dict[str, Any]]) -> dict[str, Any]:
    """Describe an image for run.json and the manifest.

    Raises
    ------
    ChangedInputError
        See `check_as_opened`.
    """
    files, crs = _with_others(image.path, identified), image.georeferencing.crs
    mask = _with_others(image.mask, identified) if image.mask else None
    check_as_opened(image)
    return {
        **files,
        "height": image.height,
        "width": image.width,
        "band": image.band,
        "dtype": image.dtype,
        "nodata": None if image.nodata is None else repr(image.nodata),
        "crs": crs.to_string() if crs else None,
        "use_mask": image.use_mask,
        "alpha": image.alpha,
        "mask": mask,
    }


def _with_others(name: str, identified: Callable[[str], dict[str, Any]]) -> dict[str, Any]:
    """Return the identity of a raster and of the other files that decide its pixels."""
    return {**identified(name), "files": [identified(file) for file in pixel_files(name)[1:]]}


def appeared_file(left: Image, right: Image, files: Mapping[str, Any]) -> str | None:
    """Return a file that images or masks are read from now, but that is no input; None if there is none.

    These are files beside sources, and other sources: a link to a virtual raster may have another target. Most files
    beside the image itself do not matter, which is read as it was when it was opened; but for a mask, if it has one.
    """
    for image in (left, right):
        for name in filter(None, (image.path, image.mask)):
            own = {f"{name}{ending}".lower() for ending in SIDECARS}
            if name == image.path and image.use_mask:
                own.remove(f"{name}.msk".lower())
            now = survey(name)
            endings = tuple(ending for ending in SIDECARS if ending != ".ovr" or now.uses_overviews)
            for file in filter(is_read, now.files):
                is_sidecar = file.lower().endswith(endings) and file.lower() not in own
                if file not in files and (is_sidecar or file in now.sources):
                    return file
    return None


def _weights_identity(cost: Mccnn) -> dict[str, Any]:
    """Return the identity of the weights and the version of onnxruntime."""
    return {**identity(str(weights_file(cost.weights))), "onnxruntime": version("onnxruntime")}


def check_onnxruntime(inputs: Mapping[str, Any]) -> None:
    """Raise if this process has another onnxruntime than the one that a run with MC-CNN began with."""
    wanted = inputs.get("weights", {}).get("onnxruntime")
    if wanted and (here := version("onnxruntime")) != wanted:
        raise ChangedInputError(
            f"onnxruntime is {here} here, but the run has {wanted}: give all workers the same version"
        )


def with_range_of(report: Mapping[str, Any], config: Config) -> Config:
    """Return the settings with the search range that a run found, if they ask for the same search as that run."""
    asked = report.get("requested", {}).get("disparity")
    if not config.disparity.is_auto or asked != config.disparity.model_dump(mode="json"):
        return config
    return config.model_copy(update={"disparity": load_config(report["settings"]).disparity})


def changes_since(
    report: Mapping[str, Any], left: Image, right: Image, config: Config, window: Window | None = None
) -> list[str]:
    """List the differences between the run of a ``run.json`` and one with these images, settings and region.

    Versions and cluster are ignored.
    """
    if config.disparity.is_auto and report.get("requested", {}).get("disparity") == config.disparity.model_dump(
        mode="json"
    ):
        config = config.model_copy(update={"disparity": load_config(report["settings"]).disparity})
    before = {
        "settings": load_config(report["settings"]).model_dump(mode="json", exclude={"cluster", "preset"}),
        "inputs": report["inputs"],
        "region": report["tiles"]["region"],
    }
    now = {
        "settings": config.model_dump(mode="json", exclude={"cluster", "preset"}),
        "inputs": describe_inputs(left, right, config, report["inputs"])[0],
        "region": asdict(window or Window(0, 0, left.height, left.width)),
    }
    for one in (before, now):
        one["inputs"].get("weights", {}).pop("onnxruntime", None)
    return [*differences(before, json.loads(json.dumps(now))), *_other_ranges(report, left, config)]


def _other_ranges(report: Mapping[str, Any], left: Image, config: Config) -> list[str]:
    """Say whether the raster of ranges has others than a run; settings have its name only."""
    search, there = config.disparity, report.get("local_ranges")
    if not search.grid or not there:
        return []
    now, before = read_ranges(search.grid, left), LocalRanges.of_report(there)
    if not isinstance(report.get("requested", {}).get("disparity", {}).get("minimum"), str):  # "auto" takes all of them
        now = now.clipped(search.minimum, search.maximum)
    is_same = np.array_equal(now.minimum, before.minimum) and np.array_equal(now.maximum, before.maximum)
    return [] if is_same else [f"{search.grid} has other ranges"]
