"""A graph of fixed shapes that onnxruntime runs faster, with the same results bit for bit.

onnxruntime's own simplification, done once and stored, and then what it does not do:

- Chains of views become one. Those without effect go, and those whose only effect is on axes of size 1 in front, where
  broadcasting does not mind them.
- Every operand of an elementwise node gets the rank of its result. An operand of fewer axes than the trailing ones of
  size 1 makes onnxruntime walk through the result number by number, which takes 100 times as long.
"""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import onnx
    import onnxruntime

ELEMENTWISE = frozenset({
    *("Add", "Sub", "Mul", "Div", "Pow", "Mod", "Max", "Min", "Where"),
    *("Less", "Greater", "LessOrEqual", "GreaterOrEqual", "Equal", "And", "Or", "Xor"),
    *("BitShift", "BitwiseAnd", "BitwiseOr", "BitwiseXor"),
})  # fmt: skip
"""Operators whose operands are broadcast to the shape of the result."""

VIEWS = frozenset(["Reshape", "Squeeze", "Unsqueeze", "Flatten", "Identity"])
"""Operators whose result is the first operand in another shape."""

FEW = 64
"""Numbers of a result up to which walking through them one by one is no slower than another node."""

Shapes = dict[str, tuple[int, ...]]
"""Shapes by names of values."""


def faster(model: "onnx.ModelProto", arguments: dict[str, np.ndarray]) -> "onnx.ModelProto":
    """The graph of `model` with fewer and faster nodes; arguments: of some run, by name."""
    import onnx

    model = simplified(model)
    graph = _Graph(model.graph, shapes_of(model, arguments))
    graph.join_views()
    graph.skip_views()
    graph.pad_operands()
    graph.drop_unread()
    onnx.checker.check_model(model)
    return model


def simplified(model: "onnx.ModelProto") -> "onnx.ModelProto":
    """The graph as onnxruntime simplifies it for any processor."""
    import onnx
    import onnxruntime

    options = _options()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_ENABLE_BASIC
    with TemporaryDirectory() as folder:
        options.optimized_model_filepath = str(Path(folder) / "simplified.onnx")
        onnxruntime.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
        return onnx.load(options.optimized_model_filepath)


def shapes_of(model: "onnx.ModelProto", arguments: dict[str, np.ndarray]) -> Shapes:
    """Shapes of all values of a graph, found by a run."""
    import onnx
    import onnxruntime

    told = onnx.ModelProto()
    told.CopyFrom(model)
    inner = [name for node in told.graph.node for name in node.output if name]
    del told.graph.output[:]
    told.graph.output.extend(onnx.ValueInfoProto(name=name) for name in inner)
    options = _options()
    options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
    session = onnxruntime.InferenceSession(told.SerializeToString(), options, providers=["CPUExecutionProvider"])
    given = {each.name: arguments[each.name] for each in session.get_inputs()}
    found = zip(inner, session.run(inner, given), strict=True)
    constants = {each.name: tuple(each.dims) for each in model.graph.initializer}
    arrays = [(name, each) for name, each in [*given.items(), *found] if isinstance(each, np.ndarray)]
    return constants | {name: each.shape for name, each in arrays}


def _options() -> "onnxruntime.SessionOptions":
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 3
    return options


class _Graph:
    """A graph that is being changed; shapes: of all its values."""

    def __init__(self, graph: "onnx.GraphProto", shapes: Shapes) -> None:
        self._graph, self._shapes = graph, shapes
        self._constants = {each.name: each for each in graph.initializer}
        self._outputs = {each.name for each in graph.output}
        self._made: dict[tuple[str, tuple[int, ...]], str] = {}

    def join_views(self) -> None:
        """Views of views become views of what these show."""
        roots: dict[str, str] = {}
        for node in self._graph.node:
            for index, name in enumerate(node.input):
                root = roots.get(name, name)
                if name != root and self._shapes[name] == self._shapes[root]:
                    node.input[index] = root
            if node.op_type not in VIEWS:
                continue
            shown, shape = node.input[0], self._shapes[node.output[0]]
            root = roots[node.output[0]] = roots.get(shown, shown)
            if node.output[0] not in self._outputs or shape != self._shapes[root]:
                self._become_reshape(node, root, shape)

    def skip_views(self) -> None:
        """Elementwise nodes read what a view shows, where the two only differ by axes of size 1 in front."""
        shown = {node.output[0]: node.input[0] for node in self._graph.node if node.op_type == "Reshape"}
        for node in self._graph.node:
            if node.op_type not in ELEMENTWISE:
                continue
            rank = len(self._shapes[node.output[0]])
            for index, name in enumerate(node.input):
                root = shown.get(name, name)
                ranks = [len(self._shapes[other]) for other in (*node.input[:index], root, *node.input[index + 1 :])]
                if max(ranks) == rank and _from_first(self._shapes[name]) == _from_first(self._shapes[root]):
                    node.input[index] = root

    def pad_operands(self) -> None:
        """Operands get the rank of an elementwise result where onnxruntime would walk through it otherwise."""
        nodes = list(self._graph.node)
        del self._graph.node[:]
        for node in nodes:
            if node.op_type in ELEMENTWISE:
                for index in self._slow_operands(node):
                    node.input[index] = self._padded(node.input[index], len(self._shapes[node.output[0]]))
            self._graph.node.append(node)

    def drop_unread(self) -> None:
        """Nodes and constants that nothing reads go."""
        read, kept = set(self._outputs), []
        for node in reversed(self._graph.node):
            if any(name in read for name in node.output):
                read.update(node.input)
                kept.append(node)
        constants = [each for each in self._graph.initializer if each.name in read]
        del self._graph.node[:], self._graph.initializer[:], self._graph.value_info[:]
        self._graph.node.extend(reversed(kept))
        self._graph.initializer.extend(constants)

    def _slow_operands(self, node: "onnx.NodeProto") -> Iterator[int]:
        shape = self._shapes[node.output[0]]
        n_ones = next((n for n, size in enumerate(reversed(shape)) if size != 1), len(shape))
        for index, name in enumerate(node.input):
            is_slow = len(self._shapes[name]) <= n_ones and len(self._shapes[name]) < len(shape)
            if is_slow and (name in self._constants or np.prod(shape) > FEW):
                yield index

    def _padded(self, name: str, rank: int) -> str:
        """Name of a value with axes of size 1 in front; its node comes before the one that is added next."""
        import onnx

        shape = (1,) * (rank - len(self._shapes[name])) + self._shapes[name]
        if (name, shape) not in self._made:
            padded = self._made[name, shape] = f"{name}_of_rank_{rank}"
            self._shapes[padded] = shape
            if name in self._constants:
                constant = onnx.TensorProto()
                constant.CopyFrom(self._constants[name])
                constant.name = padded
                constant.dims[:] = shape
                self._graph.initializer.append(constant)
            else:
                self._graph.node.append(onnx.helper.make_node("Reshape", [name, self._sizes(shape)], [padded], padded))
        return self._made[name, shape]

    def _become_reshape(self, node: "onnx.NodeProto", shown: str, shape: tuple[int, ...]) -> None:
        node.op_type = "Reshape"
        node.input[:] = [shown, self._sizes(shape)]
        del node.attribute[:]

    def _sizes(self, shape: tuple[int, ...]) -> str:
        """Name of a constant that holds a shape."""
        import onnx

        name = "_".join(["sizes", *map(str, shape)])
        if name not in self._constants:
            self._constants[name] = onnx.numpy_helper.from_array(np.array(shape, dtype=np.int64), name)
            self._graph.initializer.append(self._constants[name])
        return name


def _from_first(shape: tuple[int, ...]) -> tuple[int, ...]:
    """A shape without its axes of size 1 in front."""
    return shape[next((axis for axis, size in enumerate(shape) if size != 1), len(shape)) :]
