"""Interactive Gym's `load_policy_fn` and `policy_inference_fn` for ONNX files that RLlib has exported."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

ORT_SESSIONS: dict[str, Any] = {}
"""The loaded models by their paths."""


def load_onnx_policy_fn(onnx_model_path: str) -> str:
    """Load a model. Return its path, by which the other functions find it."""
    if onnx_model_path not in ORT_SESSIONS:
        import onnxruntime  # noqa: PLC0415 - only experiments with models need it

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        ORT_SESSIONS[onnx_model_path] = onnxruntime.InferenceSession(
            onnx_model_path, options, providers=["CPUExecutionProvider"]
        )
    return onnx_model_path


def inference_onnx_model(input_dict: Mapping[str, Any], model_path: str) -> Any:
    """Run the model, and return its outputs. Inputs that `input_dict` lacks, such as recurrent states, are zeros."""
    session = ORT_SESSIONS[model_path]
    shapes = {port.name: [size if isinstance(size, int) else 1 for size in port.shape] for port in session.get_inputs()}
    zeros = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
    return session.run(["output"], {**zeros, **input_dict})


def onnx_model_inference_fn(observation: Any, onnx_model_path: str) -> int:
    """Draw an action by the model's output for an observation. A dictionary's parts are joined in their order."""
    if isinstance(observation, Mapping):
        observation = np.hstack([np.asarray(part).reshape(-1) for part in observation.values()])
    inputs = {"obs": np.asarray(observation, np.float32).reshape(1, -1)}
    return sample_action_via_softmax(inference_onnx_model(inputs, onnx_model_path)[0])


def sample_action_via_softmax(logits: Any) -> int:
    """Draw the number of an action, with the probabilities of the softmax of `logits`."""
    weights = np.exp(np.asarray(logits, float).reshape(-1) - np.max(logits))
    return int(np.random.choice(len(weights), p=weights / weights.sum()))
