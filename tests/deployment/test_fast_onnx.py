"""Graphs that are made faster: the same results bit for bit, fewer views, no result walked through number by number."""

import time
from itertools import pairwise

import numpy as np
import pytest

onnx = pytest.importorskip("onnx")
onnxruntime = pytest.importorskip("onnxruntime")

from onnx import TensorProto, helper  # noqa: E402

from negopipe.deployment.fast_onnx import VIEWS, faster, shapes_of  # noqa: E402

SHAPE = (40, 6, 85, 1)


def model(*nodes: "onnx.NodeProto", shape: tuple[int, ...] = SHAPE) -> "onnx.ModelProto":
    """A graph from x of `SHAPE` and a number y to z of `shape`."""
    given = [
        helper.make_tensor_value_info("x", TensorProto.FLOAT, SHAPE),
        helper.make_tensor_value_info("y", TensorProto.FLOAT, [1]),
    ]
    constants = [
        helper.make_tensor("half", TensorProto.FLOAT, [], [0.5]),
        helper.make_tensor("flat", TensorProto.INT64, [1], [-1]),
        helper.make_tensor("first", TensorProto.INT64, [1], [0]),
        helper.make_tensor("shape", TensorProto.INT64, [4], SHAPE),
    ]
    found = [helper.make_tensor_value_info("z", TensorProto.FLOAT, shape)]
    graph = helper.make_graph(list(nodes), "graph", given, found, constants)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=9)


def arguments() -> dict[str, np.ndarray]:
    rng = np.random.default_rng(0)
    return {"x": rng.normal(size=SHAPE).astype(np.float32), "y": np.array([3.0], dtype=np.float32)}


def session(graph: "onnx.ModelProto") -> "onnxruntime.InferenceSession":
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(graph.SerializeToString(), options, providers=["CPUExecutionProvider"])


def test_results_stay_the_same_and_views_go() -> None:
    graph = model(
        helper.make_node("Reshape", ["x", "flat"], ["row"]),
        helper.make_node("Unsqueeze", ["row", "first"], ["rows"]),
        helper.make_node("Unsqueeze", ["y", "first"], ["number"]),
        helper.make_node("Mul", ["rows", "number"], ["scaled"]),
        helper.make_node("Reshape", ["scaled", "shape"], ["back"]),
        helper.make_node("Where", ["is_more", "back", "half"], ["z"]),
    )
    graph.graph.node.insert(5, helper.make_node("Greater", ["back", "half"], ["is_more"]))
    found = faster(graph, arguments())
    ours, theirs = (session(each).run(None, arguments())[0] for each in (graph, found))
    assert ours.tobytes() == theirs.tobytes()
    n_views = [sum(node.op_type in VIEWS for node in each.graph.node) for each in (graph, found)]
    assert n_views == [4, 2]
    shapes = shapes_of(found, arguments())
    wheres = [node for node in found.graph.node if node.op_type == "Where"]
    assert {len(shapes[name]) for name in wheres[0].input} == {len(SHAPE)}


def test_a_view_that_is_a_result_stays() -> None:
    graph = model(
        helper.make_node("Add", ["x", "y"], ["sum"]),
        helper.make_node("Reshape", ["sum", "shape"], ["z"]),
    )
    found = faster(graph, arguments())
    assert [each.name for each in found.graph.output] == ["z"]
    np.testing.assert_array_equal(session(found).run(None, arguments())[0], arguments()["x"] + 3.0)


def test_numbers_are_no_longer_walked_through_one_by_one() -> None:
    """onnxruntime takes 250 us for such a sum and 3 us for the same with an operand of four axes."""
    names = ["x", *(f"sum_{n}" for n in range(19)), "z"]
    graph = model(*(helper.make_node("Add", [one, "y"], [two]) for one, two in pairwise(names)))
    slow, fast = (session(each) for each in (graph, faster(graph, arguments())))
    seconds = []
    for each in (slow, fast):
        began = time.process_time()
        for _ in range(10):
            each.run(None, arguments())
        seconds.append(time.process_time() - began)
    assert seconds[1] < seconds[0] / 3
