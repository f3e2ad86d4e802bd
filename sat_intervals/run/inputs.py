"""The inputs of a run: described at the start, at a resume, and once before publication."""

from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

from sat_intervals.config import Config
from sat_intervals.errors import ChangedInputError, RunError
from sat_intervals.products import plain
from sat_intervals.raster import Image, describe, open_image
from sat_intervals.raster.identity import identity
from sat_intervals.store.manifest import changes


def describe_inputs(images: Mapping[str, Image], config: Config, known: Mapping[str, Any]) -> dict[str, Any]:
    """Return what identifies images and the files of the cost; see `identity` for ``known``."""
    inputs = {name: describe(image, known) for name, image in images.items()}
    if config.disparity.around:
        inputs["around"] = describe(open_image(config.disparity.around, band=1), known)
    for name, file in config.cost.files().items():
        inputs[name] = identity(str(file), known) | {package: version(package) for package in config.cost.packages}
    return inputs


def check_unchanged(before: Mapping[str, Any], images: Mapping[str, Image], config: Config) -> None:
    """Raise ChangedInputError if inputs differ from their description of before; all local files are read."""
    try:
        now = plain(describe_inputs(images, config, {}))
    except (OSError, ChangedInputError) as error:
        raise RunError(f"an input cannot be compared now: {error}; rerun the same command: it resumes") from error
    if changed := changes("an input", before, now):
        path = before[changed[0].partition(".")[0]]["path"]
        raise ChangedInputError(
            f"{path} was changed during the run ({'; '.join(changed)}), so its tiles are deleted: rerun the command "
            "when the file is complete"
        )
