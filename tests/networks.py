"""ONNX networks of MC-CNN fast's form: from trained weights kept as arrays, and small random ones."""

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

CONVOLUTIONS = (0, 2, 4, 6, 8)


def random_weights(features=8, layers=5, seed=0):
    """Arrays of a network of few features, with the names of the trained ones."""
    random = np.random.default_rng(seed)
    weights = {}
    for layer in CONVOLUTIONS[:layers]:
        shape = features, 1 if layer == 0 else features, 3, 3
        weights[f"conv_blocks.{layer}.weight"] = random.standard_normal(shape, np.float32) / float(shape[1] * 9) ** 0.5
        weights[f"conv_blocks.{layer}.bias"] = random.standard_normal(features, np.float32) / 8
    return weights


def write_network(file, weights, *, unit=True, pads=0, rank=2):
    """Write convolutions with ReLU between them, and unit vectors; the other options make networks of another form."""
    layers = [layer for layer in CONVOLUTIONS if f"conv_blocks.{layer}.weight" in weights]
    constants = {"first two axes": [0, 1], "first axis": [0], "second axis": [1]}
    parts = [numpy_helper.from_array(np.array(value, np.int64), name) for name, value in constants.items()]
    nodes, last = [], "input"
    if rank == 2:
        nodes.append(helper.make_node("Unsqueeze", ["input", "first two axes"], ["image"]))
        last = "image"
    for layer in layers:
        names = [f"conv_blocks.{layer}.{part}" for part in ("weight", "bias")]
        parts += [numpy_helper.from_array(np.asarray(weights[name]), name) for name in names]
        nodes.append(helper.make_node("Conv", [last, *names], [f"sum {layer}"], pads=[pads] * 4))
        last = f"sum {layer}"
        if layer != layers[-1]:
            nodes.append(helper.make_node("Relu", [last], [f"relu {layer}"]))
            last = f"relu {layer}"
    if unit:
        nodes.append(helper.make_node("ReduceL2", [last, "second axis"], ["length"], keepdims=1))
        nodes.append(helper.make_node("Div", [last, "length"], ["unit"]))
        last = "unit"
    nodes.append(helper.make_node("Squeeze", [last, "first axis"], ["output"]))
    sizes = ["height", "width"] if rank == 2 else [1, 1, "height", "width"]
    inputs = [helper.make_tensor_value_info("input", TensorProto.FLOAT, sizes)]
    outputs = [helper.make_tensor_value_info("output", TensorProto.FLOAT, ["features", "rows", "columns"])]
    graph = helper.make_graph(nodes, "mc_cnn_fast", inputs, outputs, parts)
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9), file)
    return file


def trained_network(shared_data, file, name="mb_weights"):
    """Write the network of trained weights."""
    with np.load(shared_data / "mccnn_weights" / f"mc_cnn_fast_{name}.npz") as weights:
        return write_network(file, weights)


def slow_features(weights, pixels):
    """Its unit vectors, by plain sums."""
    maps = pixels[np.newaxis].astype(np.float64)
    layers = [layer for layer in CONVOLUTIONS if f"conv_blocks.{layer}.weight" in weights]
    for layer in layers:
        weight, bias = (weights[f"conv_blocks.{layer}.{part}"].astype(np.float64) for part in ("weight", "bias"))
        windows = np.lib.stride_tricks.sliding_window_view(maps, (3, 3), axis=(1, 2))
        maps = np.einsum("oirc,iyxrc->oyx", weight, windows) + bias[:, np.newaxis, np.newaxis]
        if layer != layers[-1]:
            maps = np.maximum(maps, 0)
    return maps / np.linalg.norm(maps, axis=0)
