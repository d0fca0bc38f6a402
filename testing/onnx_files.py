"""ONNX files of tests: writes small policies in the forms that researchers export, with the package `onnx`; runs them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

Shape = Sequence[int | str]
_IR, _OPSET = 8, 17  # versions that onnxruntime has read since 2022


def save(
    file: Path,
    nodes: Sequence[Any],
    inputs: Sequence[tuple[str, Shape]],
    outputs: Sequence[tuple[str, Shape]],
    values: dict[str, Any] | None = None,
    *,
    types: dict[str, int] | None = None,
) -> Path:
    """Write a graph to the file, and return the file.

    `values` are its constants by name; `types` are the element types of the inputs and outputs that are not float32.
    """
    kinds = types or {}
    graph = helper.make_graph(
        list(nodes),
        "policy",
        [helper.make_tensor_value_info(name, kinds.get(name, TensorProto.FLOAT), shape) for name, shape in inputs],
        [helper.make_tensor_value_info(name, kinds.get(name, TensorProto.FLOAT), shape) for name, shape in outputs],
        [numpy_helper.from_array(np.asarray(value), name) for name, value in (values or {}).items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR)
    onnx.checker.check_model(model)
    file.parent.mkdir(parents=True, exist_ok=True)
    onnx.save(model, str(file))
    return file


def linear(file: Path, weights: Any, *, shape: Shape | None = None) -> Path:
    """Write the policy `output = obs @ weights`, with a column of weights for each action; return the file.

    `shape` is that of `obs`, if it is another one than (batch, rows of weights).
    """
    matrix = np.asarray(weights, np.float32)
    sizes = shape or ("batch", matrix.shape[0])
    flat = helper.make_node("Reshape", ["obs", "rows"], ["flat"])
    product = helper.make_node("MatMul", ["flat", "weights"], ["output"])
    rows = np.array([-1, matrix.shape[0]], np.int64)
    return save(
        file,
        [flat, product],
        [("obs", sizes)],
        [("output", ("batch", matrix.shape[1]))],
        {"weights": matrix, "rows": rows},
    )


def constant(file: Path, values: Any, *, size: int = 2, dtype: int = TensorProto.FLOAT) -> Path:
    """Write a policy that gives these values for every observation of `size` numbers; return the file."""
    row = np.asarray(values)
    nodes = [
        helper.make_node("ReduceSum", ["obs"], ["sum"], keepdims=0),
        helper.make_node("Mul", ["sum", "zero"], ["nothing"]),
        helper.make_node("Cast", ["nothing"], ["none"], to=dtype),
        helper.make_node("Add", ["none", "values"], ["output"]),
    ]
    return save(
        file,
        nodes,
        [("obs", ("batch", size))],
        [("output", row.shape)],
        {"zero": np.float32(0), "values": row},
        types={"output": dtype},
    )


def counter(
    file: Path, *, state: tuple[str, str] = ("state_in_0", "state_out_0"), seq_lens: Shape | None = (1,)
) -> Path:
    """Write a recurrent policy of three actions, which takes action 0, 1, 2, 2, … after each reset; return the file.

    `state` are the names of its state's input and output; `seq_lens` is the shape of RLlib's input of that name, None
    for none.
    """
    nodes = [
        helper.make_node("Add", [state[0], "one"], [state[1]]),
        helper.make_node("Sub", ["centers", state[0]], ["distance"]),
        helper.make_node("Abs", ["distance"], ["far"]),
        helper.make_node("Neg", ["far"], ["near"]),
        helper.make_node("ReduceSum", ["obs"], ["sum"], keepdims=0),
        helper.make_node("Mul", ["sum", "zero"], ["nothing"]),
        helper.make_node("Add", ["near", "nothing"], ["output"]),
    ]
    inputs: list[tuple[str, Shape]] = [("obs", ("batch", 2)), (state[0], ("batch", 1))]
    values = {"one": np.ones((1, 1), np.float32), "centers": np.array([[0, 1, 2]], np.float32), "zero": np.float32(0)}
    if seq_lens is not None:
        inputs.append(("seq_lens", seq_lens))
    return save(file, nodes, inputs, [("output", ("batch", 3)), (state[1], ("batch", 1))], values)


def endless(file: Path) -> Path:
    """Write a policy of three actions that computes for hours on any observation but zeros; return the file."""
    body = helper.make_graph(
        [helper.make_node("Identity", ["more"], ["goes_on"]), helper.make_node("Sin", ["before"], ["after"])],
        "body",
        [
            helper.make_tensor_value_info("index", TensorProto.INT64, []),
            helper.make_tensor_value_info("more", TensorProto.BOOL, []),
            helper.make_tensor_value_info("before", TensorProto.FLOAT, [1, 3]),
        ],
        [
            helper.make_tensor_value_info("goes_on", TensorProto.BOOL, []),
            helper.make_tensor_value_info("after", TensorProto.FLOAT, [1, 3]),
        ],
    )
    nodes = [
        helper.make_node("ReduceMax", ["obs"], ["largest"], keepdims=0),
        helper.make_node("Mul", ["largest", "many"], ["product"]),
        helper.make_node("Cast", ["product"], ["times"], to=TensorProto.INT64),
        helper.make_node("Loop", ["times", "go_on", "start"], ["output"], body=body),
    ]
    constants = {"many": np.float32(1e12), "go_on": np.bool_(True), "start": np.zeros((1, 3), np.float32)}
    return save(file, nodes, [("obs", (1, 2))], [("output", (1, 3))], constants)


def session(file: Path) -> Any:
    """Return an `onnxruntime.InferenceSession` that runs the file."""
    import onnxruntime  # it starts threads at once, which a process that forks must not have

    return onnxruntime.InferenceSession(file)
