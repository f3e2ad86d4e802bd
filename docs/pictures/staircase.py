"""Draw hillshades of disparities by V-fit and least squares, for README: ``python docs/pictures/staircase.py FILE``."""

import sys

import matplotlib as mpl
import matplotlib.pyplot as plt
from matplotlib.colors import LightSource

from sat_intervals import match_arrays
from sat_intervals.demo import make_scene

mpl.use("Agg")
SUN, PART = LightSource(315, 35), (slice(90, 250), slice(130, 350))
TITLES = {"vfit": "V-fit", "least_squares": "least squares, the default"}


def main(file):
    """Draw both beside the exact disparities."""
    scene = make_scene(260, 360, seed=4, relief=25)
    search = {"minimum": scene.minimum, "maximum": scene.maximum}
    figure, panels = plt.subplots(1, 3, figsize=(13, 3.5), layout="constrained")
    for panel, (method, title) in zip(panels, TITLES.items(), strict=False):
        settings = {"disparity": search, "refinement": {"method": method}, "interval": {"alpha": 0.9}}
        found = match_arrays(scene.left, scene.right, settings)
        panel.imshow(SUN.hillshade(found["disparity"].values[PART], vert_exag=1.5), cmap="gray")
        panel.set_title(title)
    panels[2].imshow(SUN.hillshade(scene.truth[PART], vert_exag=1.5), cmap="gray")
    panels[2].set_title("exact")
    for panel in panels:
        panel.set_axis_off()
    figure.savefig(file, dpi=72)


if __name__ == "__main__":
    main(sys.argv[1])
