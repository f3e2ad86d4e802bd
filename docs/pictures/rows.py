"""Draw the row offsets of a demo pair whose right image was moved by a plane: ``python docs/pictures/rows.py FILE``."""

import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import rasterio
from numpy import zeros

from sat_intervals.kernels.row_offsets import RowOffsets, shift_rows


def main(file):
    """Make the pair, match it and plot it with the commands."""
    command = Path(sys.executable).with_name("sat-intervals")
    with TemporaryDirectory() as folder:
        subprocess.run([command, "demo", folder, "--size", "700", "900", "--overwrite", "--quiet"], check=True)
        with rasterio.open(f"{folder}/right.tif", "r+") as dataset:
            pixels = dataset.read(1).astype("float64")
            # read from higher rows: its content lies lower
            first, count, *places = RowOffsets((-1.6, -1.2, 0.5), *pixels.shape).read(0, 0, *pixels.shape)
            wider = zeros((count, pixels.shape[1]))
            wider[-first : -first + len(pixels)] = pixels[: count + first]
            dataset.write(shift_rows(wider, (wider == 0).astype("uint8"), *places)[0].round().astype("uint16"), 1)
        match = ["match", f"{folder}/left.tif", f"{folder}/right.tif", f"{folder}/out", "--disparity", "-20", "36"]
        subprocess.run([command, *match, "--quiet"], check=True)
        subprocess.run([command, "plot", f"{folder}/out", "--dpi", "72"], check=True, stdout=subprocess.DEVNULL)
        shutil.copy(f"{folder}/out/rows.png", file)


if __name__ == "__main__":
    main(sys.argv[1])
