"""Which inputs a run has: their files, what they hold, the weights of MC-CNN; and what changed since a run before."""

import json
from collections.abc import Callable, Mapping
from dataclasses import asdict
from importlib.metadata import version
from typing import Any

from sat_intervals.config import Config, Mccnn, load_config
from sat_intervals.match.mccnn import weights_file
from sat_intervals.raster import Image, other_files
from sat_intervals.raster.identity import ChangedInputError, identity
from sat_intervals.store.manifest import differences
from sat_intervals.tiling import Window


def describe_inputs(
    left: Image, right: Image, config: Config, before: Mapping[str, Any]
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """What run.json and the manifest say of the inputs, and of each file of the images by its name.

    What they said before saves hashing files again.
    """
    known, files = _known(before), {}

    def told(name: str) -> dict[str, Any]:
        if name not in files:
            files[name] = identity(name, known)
        return files[name]

    inputs = {"left": _described(left, told), "right": _described(right, told)}
    if isinstance(config.cost, Mccnn):
        inputs["weights"] = _weights_identity(config.cost)
    return inputs, files


def _known(inputs: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """What a manifest says of the files of its inputs, by path."""
    ways = [one for both in inputs.values() for one in (both, both.get("mask")) if one]
    described = [file for one in ways for file in (one, *one.get("files", ()))]
    return {file["path"]: file for file in described if "sha256" in file}


def _described(image: Image, told: Callable[[str], dict[str, Any]]) -> dict[str, Any]:
    """What run.json and the manifest say of an input.

    Raises
    ------
    ChangedInputError
        A file that is not the one that was opened, of which band and no-data value are.
    """
    files, crs = _with_others(image.path, told), image.georeferencing.crs
    if files.get("stamp") != image.stamp:
        raise ChangedInputError(f"{image.path} was replaced or changed since it was opened: run the command again")
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
        "mask": _with_others(image.mask, told) if image.mask else None,
    }


def _with_others(name: str, told: Callable[[str], dict[str, Any]]) -> dict[str, Any]:
    """What is told of a raster, and of the other files it is read from."""
    return {**told(name), "files": [told(file) for file in other_files(name)]}


def _weights_identity(cost: Mccnn) -> dict[str, Any]:
    """What run.json and the manifest say of the weights, and of what runs them."""
    return {**identity(str(weights_file(cost.weights))), "onnxruntime": version("onnxruntime")}


def check_weights(cost: Mccnn, wanted: Mapping[str, Any]) -> None:
    """Hold that this process finds the weights of the run, and what runs them.

    Raises
    ------
    ChangedInputError
        It does not.
    """
    here = _weights_identity(cost)
    for key in ("sha256", "onnxruntime"):
        if here[key] != wanted[key]:
            raise ChangedInputError(
                f"{here['path']} differs in {key} from {wanted['path']} of the run: it was replaced, or this worker "
                "has another"
            )


def changes_since(report: Mapping[str, Any], left: Image, right: Image, config: Config) -> list[str]:
    """In what the run of a ``run.json`` differs from one of whole images with settings, a line each.

    Versions do not count, and neither does where tiles were matched.
    """
    before = {
        "settings": load_config(report["settings"]).model_dump(mode="json", exclude={"cluster", "preset"}),
        "inputs": report["inputs"],
        "region": report["tiles"]["region"],
    }
    now = {
        "settings": config.model_dump(mode="json", exclude={"cluster", "preset"}),
        "inputs": describe_inputs(left, right, config, report["inputs"])[0],
        "region": asdict(Window(0, 0, left.height, left.width)),
    }
    for one in (before, now):
        one["inputs"].get("weights", {}).pop("onnxruntime", None)
    return list(differences(before, json.loads(json.dumps(now))))
