"""Measure one candidate in a separate process: ``python candidates.py NAME ROWS COLUMNS DISPARITIES RUNS``.

Prints JSON: the seconds of each run after a first one that is not counted, those of them that went into the network
of MC-CNN, and the process's peak memory in MB.
"""

import json
import os
import resource
import sys
import time
import warnings
from functools import partial
from pathlib import Path

for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ[variable] = "1"

import numpy as np  # noqa: E402 (its threads are set by then)

SCENE = Path(__file__).with_name("scene.npz")


def make_pair(rows, columns):
    """A procedural pair of any size: one scene of 1000 x 1000, side by side and mirrored downwards."""
    if not SCENE.exists():
        from sat_intervals.demo import make_scene

        scene = make_scene(1000, 1000)
        np.savez(SCENE.with_suffix(".part.npz"), left=scene.left, right=scene.right)
        SCENE.with_suffix(".part.npz").replace(SCENE)
    with np.load(SCENE) as stored:
        images = [stored["left"], stored["right"]]
    times = -(-rows // 1000), -(-columns // 1000)
    return [np.ascontiguousarray(np.tile(image, times)[:rows, :columns]) for image in images]


def search_range(disparities):
    """A range with a given number of disparities around those of the scene."""
    return 8 - disparities // 2, 8 - disparities // 2 + disparities - 1


def ours(left, right, disparities, cost="census"):
    """The whole chain of this project in memory."""
    from sat_intervals import match_arrays

    minimum, maximum = search_range(disparities)
    preset = "mccnn" if cost == "mccnn" else "paper"
    settings = {"preset": preset, "disparity": {"minimum": minimum, "maximum": maximum}}
    left, right = (np.ma.masked_equal(image, 0) for image in (left, right))
    return lambda: match_arrays(left, right, settings)


def opencv(left, right, disparities):
    """OpenCV's StereoSGBM over 8 paths (MODE_HH): a disparity alone."""
    import cv2

    cv2.setNumThreads(1)
    matcher = cv2.StereoSGBM_create(
        minDisparity=-search_range(disparities)[1],
        numDisparities=disparities,
        blockSize=5,
        P1=8 * 25,
        P2=32 * 25,
        disp12MaxDiff=1,
        mode=cv2.STEREO_SGBM_MODE_HH,
    )
    left, right = (np.clip(image // 8, 0, 255).astype(np.uint8) for image in (left, right))
    return lambda: matcher.compute(left, right)


def watch_network(name):
    """Return a figure to which each call of a network, ours or the reference's, adds its seconds."""
    if name.startswith("pandora"):
        from mc_cnn.inference_engine.inference_engine_onnx import ONNXEngine as Network

        method = "inference_func"
    else:
        from sat_intervals.match.mccnn import Network

        method = "__call__"
    spent, function = [0.0], getattr(Network, method)

    def watched(self, pixels):
        started = time.perf_counter()
        features = function(self, pixels)
        spent[0] += time.perf_counter() - started
        return features

    setattr(Network, method, watched)
    return spent


def pandora(left, right, disparities, cost="census"):
    """The same steps of Pandora with libSGM: cost, SGM, confidence, intervals, refinement, fast cross-check, median."""
    import tempfile

    import pandora as peer
    import rasterio
    from pandora.check_configuration import check_conf
    from pandora.img_tools import create_dataset_from_inputs
    from pandora.state_machine import PandoraMachine

    warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
    peer.import_plugin()
    sides = {}
    with tempfile.TemporaryDirectory() as folder:
        for side, image, sign in (("left", left, 1), ("right", right, -1)):
            path = f"{folder}/{side}.tif"
            kind = {"height": image.shape[0], "width": image.shape[1], "count": 1, "dtype": image.dtype}
            with rasterio.open(path, "w", driver="GTiff", **kind) as file:
                file.write(image, 1)
            sides[side] = {"img": path, "nodata": 0, "disp": sorted(sign * d for d in search_range(disparities))}
        machine = PandoraMachine()
        pipeline = PIPELINE | (MCCNN if cost == "mccnn" else {})
        settings = check_conf({"input": sides, "pipeline": pipeline}, machine)
        images = [create_dataset_from_inputs(input_config=settings["input"][side]) for side in sides]
    return lambda: peer.run(machine, *images, settings)


PIPELINE = {
    "matching_cost": {"matching_cost_method": "census", "window_size": 5, "subpix": 1},
    "optimization": {
        "optimization_method": "sgm",
        "overcounting": False,
        "min_cost_paths": False,
        "penalty": {"penalty_method": "sgm_penalty", "p2_method": "constant", "P1": 8, "P2": 32},
    },
    "cost_volume_confidence.ambiguity": {"confidence_method": "ambiguity", "eta_max": 0.7, "eta_step": 0.01},
    "cost_volume_confidence.intervals": {
        "confidence_method": "interval_bounds",
        "possibility_threshold": 0.9,
    },
    "disparity": {"disparity_method": "wta", "invalid_disparity": "NaN"},
    "refinement": {"refinement_method": "vfit"},
    "validation": {"validation_method": "cross_checking_fast"},
    "filter": {
        "filter_method": "median_for_intervals",
        "filter_size": 3,
        "interval_indicator": "intervals",
        "regularization": True,
        "ambiguity_indicator": "ambiguity",
        "vertical_depth": 2,
        "quantile_regularization": 0.9,
    },
}


MCCNN = {
    "matching_cost": {"matching_cost_method": "mc_cnn", "window_size": 11, "subpix": 1},
    "optimization": PIPELINE["optimization"] | {"penalty": {"penalty_method": "mc_cnn_fast_penalty"}},
}

CANDIDATES = {
    "ours": ours,
    "ours_mccnn": partial(ours, cost="mccnn"),
    "opencv": opencv,
    "pandora": pandora,
    "pandora_mccnn": partial(pandora, cost="mccnn"),
}


def main():
    """Measure the candidate named on the command line."""
    name, (rows, columns, disparities, runs) = sys.argv[1], map(int, sys.argv[2:6])
    task = CANDIDATES[name](*make_pair(rows, columns), disparities)
    spent = watch_network(name) if name.endswith("mccnn") else [0.0]
    seconds, network = [], []
    for _ in range(runs + 1):
        before, started = spent[0], time.perf_counter()
        task()
        seconds.append(time.perf_counter() - started)
        network.append(spent[0] - before)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"seconds": seconds[1:], "network": network[1:], "megabytes": peak}))


if __name__ == "__main__":
    main()
