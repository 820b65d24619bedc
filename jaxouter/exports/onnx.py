"""The controller as an ONNX graph; needs the extra `onnx`.

    inputs   r (), y (), y_past (M,), r_tilde_past (M,), integral ()
    outputs  r_tilde (), y_past_next (M,), r_tilde_past_next (M,), integral_next ()

All are float32. The graph has no memory: feed each output `..._next` back in at the next control step. The model's
metadata give the initial values, units and bounds.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from jaxouter.exports.spec import ControllerSpec

try:
    import onnx
    from onnx import helper, numpy_helper
except ImportError as error:
    raise ImportError('jaxouter.exports.onnx needs ONNX: pip install "jaxouter[onnx]"') from error

OPSET, IR_VERSION = 17, 8  # of 2022, so that the runtimes of embedded controllers can read them too
START = (
    "Before the first step: y_past is filled with the first y, r_tilde_past with that y clipped to "
    "[r_tilde_min, r_tilde_max], integral is 0."
)


class _Graph:
    """Collects nodes and constants."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def constant(self, name: str, value: Any, dtype: Any = np.float32) -> str:
        self.constants.append(numpy_helper.from_array(np.asarray(value, dtype), name))
        return name

    def add(self, kind: str, output: str, *inputs: str, **attributes: Any) -> str:
        self.nodes.append(helper.make_node(kind, list(inputs), [output], name=output, **attributes))
        return output


def model(spec: ControllerSpec) -> onnx.ModelProto:
    """The graph of `ControllerSpec.act`, checked."""
    graph = _Graph()
    observation = _observation(graph, spec)
    action = _network(graph, spec, observation)
    low, high = spec.r_tilde_bounds
    scaled = graph.add("Mul", "action_scaled", action, graph.constant("scale", spec.scale))
    base = _base(graph, spec)
    unclipped = graph.add("Add", "r_tilde_unclipped", base, scaled)
    bounds = graph.constant("r_tilde_min", low), graph.constant("r_tilde_max", high)
    graph.add("Clip", "r_tilde", unclipped, *bounds)
    _remember(graph)
    past, y = [spec.remembered], spec.y_unit
    made = helper.make_graph(
        graph.nodes,
        f"{spec.plant} outer loop",
        [
            _value("r", [], f"reference, {y}"),
            _value("y", [], f"measured output, {y}"),
            _value("y_past", past, f"y of the steps before, newest first, {y}"),
            _value("r_tilde_past", past, f"r~ of the steps before, newest first, {y}"),
            _value("integral", [], f"leaky integral of r - y, {y}"),
        ],
        [
            _value("r_tilde", [], f"modified reference for the closed loop, {y}"),
            _value("y_past_next", past, "y_past of the next step"),
            _value("r_tilde_past_next", past, "r_tilde_past of the next step"),
            _value("integral_next", [], "integral of the next step"),
        ],
        graph.constants,
    )
    opset = helper.make_opsetid("", OPSET)
    out = helper.make_model(made, opset_imports=[opset], ir_version=IR_VERSION, producer_name="jaxouter")
    out.doc_string = (
        f"Outer loop around {spec.plant}; run it once every {spec.control_step:g} {spec.time_unit}. {START}"
    )
    helper.set_model_props(out, metadata(spec))
    onnx.checker.check_model(out, full_check=True)
    return out


def metadata(spec: ControllerSpec) -> dict[str, str]:
    """What a caller needs to know, as strings for the model's metadata."""
    (low, high), (r_min, r_max), (y_min, y_max) = spec.r_tilde_bounds, spec.setpoint_range, spec.y_range
    numbers = {"control_step": spec.control_step, "r_tilde_min": low, "r_tilde_max": high}
    numbers |= {"r_min": r_min, "r_max": r_max, "y_min": y_min, "y_max": y_max, "past": spec.remembered}
    texts = {"plant": spec.plant, "y_unit": spec.y_unit, "time_unit": spec.time_unit, "start": START}
    return texts | {name: repr(value) for name, value in numbers.items()}


def save(spec: ControllerSpec, path: Path) -> None:
    """Write the model."""
    onnx.save(model(spec), path)


def _value(name: str, shape: list[int], text: str) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, shape, text)


def _observation(graph: _Graph, spec: ControllerSpec) -> str:
    """The observation of `jaxouter.loop.observation.Observer`, (3 + 2H,); also adds `error` and `integral_next`."""
    low, high = spec.r_tilde_bounds
    error = graph.add("Sub", "error", "r", "y")
    change = graph.add("Sub", "error_minus_integral", error, "integral")
    leak = graph.add("Div", "integral_change", change, graph.constant("integral_steps", spec.integral_steps))
    integral = graph.add("Add", "integral_next", "integral", leak)
    above = graph.add("Sub", "r_above_middle", "r", graph.constant("y_middle", spec.y_middle))
    axis = graph.constant("first_axis", [0], np.int64)
    present = [graph.add("Unsqueeze", f"{name}_1", name, axis) for name in (above, error, integral)]
    past = graph.add("Sub", "y_past_minus_y", _newest(graph, "observed", "y_past", spec.history), "y")
    of_y = graph.add("Concat", "of_y", *present, past, axis=0)
    of_y = graph.add("Div", "of_y_scaled", of_y, graph.constant("y_scale", spec.y_scale))
    newest = _newest(graph, "observed", "r_tilde_past", spec.history)
    around = graph.add("Sub", "of_r_tilde", newest, graph.constant("r_tilde_middle", (low + high) / 2))
    of_r_tilde = graph.add("Div", "of_r_tilde_scaled", around, graph.constant("r_tilde_scale", (high - low) / 2))
    return graph.add("Concat", "observation", of_y, of_r_tilde, axis=0)


def _base(graph: _Graph, spec: ControllerSpec) -> str:
    """The base law, a scalar."""
    law = graph.add("Mul", "of_r", graph.constant("base_r", spec.base_r), "r")
    law = graph.add("Add", "base_of_r", law, graph.constant("base_offset", spec.base_offset))
    if not spec.lags:
        return law
    law = graph.add("Add", "base_of_r_y", law, graph.add("Mul", "of_y_now", graph.constant("base_y", spec.base_y), "y"))
    moved = graph.add("Sub", "base_y_past_minus_y", _newest(graph, "base", "y_past", spec.lags), "y")
    applied = _newest(graph, "base", "r_tilde_past", spec.lags)
    for name, past in (("base_y_past", moved), ("base_r_tilde_past", applied)):
        product = graph.add("MatMul", f"of_{name}", past, graph.constant(name, getattr(spec, name)))
        law = graph.add("Add", f"base_with_{name}", law, product)
    return law


def _newest(graph: _Graph, use: str, past: str, samples: int) -> str:
    """The newest samples of y_past or r_tilde_past, for the base law or for the observation."""
    name = f"{use}_{past}_newest"
    begin, end = (graph.constant(f"{name}_{i}", [i], np.int64) for i in (0, samples))
    return graph.add("Slice", name, past, begin, end)


def _network(graph: _Graph, spec: ControllerSpec, x: str) -> str:
    """The action, a scalar in [-1, 1]."""
    for i, (weight, bias) in enumerate(zip(spec.weights, spec.biases, strict=True)):
        x = graph.add("MatMul", f"product_{i}", x, graph.constant(f"weight_{i}", weight))
        x = graph.add("Add", f"layer_{i}", x, graph.constant(f"bias_{i}", bias))
        x = graph.add("Tanh", "tanh", x) if i == len(spec.weights) - 1 else graph.add("Relu", f"relu_{i}", x)
    return graph.add("Squeeze", "action", x, "first_axis")


def _remember(graph: _Graph) -> None:
    """Shift the histories: newest sample in front, oldest one dropped."""
    begin, end = graph.constant("begin", [0], np.int64), graph.constant("all_but_last", [-1], np.int64)
    for name, newest in (("y_past", "y"), ("r_tilde_past", "r_tilde")):
        kept = graph.add("Slice", f"{name}_kept", name, begin, end)
        graph.add(
            "Concat", f"{name}_next", graph.add("Unsqueeze", f"{name}_newest", newest, "first_axis"), kept, axis=0
        )
