"""The controller as an ONNX graph; needs the extra `onnx`.

    inputs   r (), y (), y_past (M,), r_tilde_past (M,), integral ()
    outputs  r_tilde (), y_past_next (M,), r_tilde_past_next (M,), integral_next ()

With a bank of L base laws there are also mean_error (L,), performance (L,) and active (), and their ..._next. All are
float32, but active is int32. The graph has no memory: feed each output `..._next` back in at the next control step. The
model's metadata give the initial values, units and bounds.
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
START_OF_BANK = " mean_error and performance are 0, active is -1."


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
    active = _judge(graph, spec) if spec.laws > 1 else None
    observation = _observation(graph, spec, active)
    action = _network(graph, spec, observation)
    low, high = spec.r_tilde_bounds
    scaled = graph.add("Mul", "action_scaled", action, graph.constant("scale", spec.scale))
    base = _base(graph, spec, active)
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
            *_evidence(spec),
        ],
        [
            _value("r_tilde", [], f"modified reference for the closed loop, {y}"),
            _value("y_past_next", past, "y_past of the next step"),
            _value("r_tilde_past_next", past, "r_tilde_past of the next step"),
            _value("integral_next", [], "integral of the next step"),
            *_evidence(spec, "_next"),
        ],
        graph.constants,
    )
    opset = helper.make_opsetid("", OPSET)
    out = helper.make_model(made, opset_imports=[opset], ir_version=IR_VERSION, producer_name="jaxouter")
    said = metadata(spec)
    every = f"{spec.control_step:g} {spec.time_unit}"
    out.doc_string = f"Outer loop around {spec.plant}; run it once every {every}. {said['start']}"
    helper.set_model_props(out, said)
    onnx.checker.check_model(out, full_check=True)
    return out


def metadata(spec: ControllerSpec) -> dict[str, str]:
    """What a caller needs to know, as strings for the model's metadata."""
    (low, high), (r_min, r_max), (y_min, y_max) = spec.r_tilde_bounds, spec.setpoint_range, spec.y_range
    numbers = {"control_step": spec.control_step, "r_tilde_min": low, "r_tilde_max": high}
    numbers |= {"r_min": r_min, "r_max": r_max, "y_min": y_min, "y_max": y_max, "past": spec.remembered}
    texts = {"plant": spec.plant, "y_unit": spec.y_unit, "time_unit": spec.time_unit, "start": START}
    texts["start"] += START_OF_BANK if spec.laws > 1 else ""
    return texts | {name: repr(value) for name, value in numbers.items()}


def save(spec: ControllerSpec, path: Path) -> None:
    """Write the model."""
    onnx.save(model(spec), path)


def _value(name: str, shape: list[int], text: str, kind: int = onnx.TensorProto.FLOAT) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, kind, shape, text)


def _evidence(spec: ControllerSpec, suffix: str = "") -> list[onnx.ValueInfoProto]:
    """What a controller with several laws remembers of them."""
    if spec.laws == 1:
        return []
    return [
        _value(f"mean_error{suffix}", [spec.laws], f"of each law's model, lately, {spec.y_unit}"),
        _value(f"performance{suffix}", [spec.laws], "index of each model; the law of the lowest one acts"),
        _value(f"active{suffix}", [], "number of the law that acts", onnx.TensorProto.INT32),
    ]


def _judge(graph: _Graph, spec: ControllerSpec) -> str:
    """How well the models predict y, and number of the law that acts."""
    error = graph.add("Sub", "error_without_y", "y", graph.constant("of_nothing", np.zeros(spec.laws)))
    for name, past in (("model_y", "y_past"), ("model_r_tilde", "r_tilde_past")):
        seen = _newest(graph, "judged", past, spec.model_lags)
        of_past = graph.add("MatMul", f"by_{name}", graph.constant(name, getattr(spec, name)), seen)
        error = graph.add("Sub", f"error_by_{name}", error, of_past)
    first = graph.constant("first", 0, np.int32)
    begins = graph.add("Less", "begins", "active", first)
    mean = graph.add("Where", "mean_error_begun", begins, error, "mean_error")
    error = graph.add("Sub", "error_beyond_mean", error, mean)
    change = graph.add("Mul", "mean_error_change", error, graph.constant("mean_rate", spec.mean_rate))
    graph.add("Add", "mean_error_next", mean, change)
    squared = graph.add("Mul", "error_squared", error, error)
    weighted = graph.add("Mul", "error_weighted", squared, graph.constant("error_weight", spec.error_weight))
    kept = graph.add("Mul", "performance_kept", "performance", graph.constant("forgetting", spec.forgetting))
    performance = graph.add("Add", "performance_next", kept, weighted)
    compared = graph.add("Add", "performance_compared", performance, graph.constant("floor", spec.floor))
    active = graph.add("Where", "active_begun", begins, first, "active")
    best = graph.add("ArgMin", "best_wide", performance, axis=0, keepdims=0)
    best = graph.add("Cast", "best", best, to=onnx.TensorProto.INT32)
    of_best, of_active = (graph.add("Gather", f"performance_of_{each}", compared, each) for each in (best, active))
    asked = graph.add("Mul", "performance_asked", of_best, graph.constant("hysteresis", spec.hysteresis))
    better = graph.add("Less", "better", asked, of_active)
    return graph.add("Where", "active_next", better, best, active)


def _observation(graph: _Graph, spec: ControllerSpec, active: str | None) -> str:
    """The observation of `jaxouter.loop.observation.Observer`, (n,); also adds `error` and `integral_next`."""
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
    which = []
    if active is not None:
        which = [graph.add("Gather", "which_law", graph.constant("one_of_the_laws", np.eye(spec.laws)), active, axis=0)]
    return graph.add("Concat", "observation", of_y, of_r_tilde, *which, axis=0)


def _base(graph: _Graph, spec: ControllerSpec, active: str | None) -> str:
    """The base law, a scalar."""

    def number(name: str) -> str:
        of_laws = getattr(spec, name)
        if active is None:
            return graph.constant(name, of_laws[0])
        return graph.add("Gather", f"{name}_active", graph.constant(name, of_laws), active, axis=0)

    law = graph.add("Mul", "of_r", number("base_r"), "r")
    law = graph.add("Add", "base_of_r", law, number("base_offset"))
    if not spec.lags:
        return law
    law = graph.add("Add", "base_of_r_y", law, graph.add("Mul", "of_y_now", number("base_y"), "y"))
    moved = graph.add("Sub", "base_y_past_minus_y", _newest(graph, "base", "y_past", spec.lags), "y")
    applied = _newest(graph, "base", "r_tilde_past", spec.lags)
    for name, past in (("base_y_past", moved), ("base_r_tilde_past", applied)):
        product = graph.add("MatMul", f"of_{name}", past, number(name))
        law = graph.add("Add", f"base_with_{name}", law, product)
    return law


def _newest(graph: _Graph, use: str, past: str, samples: int) -> str:
    """The newest samples of y_past or r_tilde_past, for the base law, the models or the observation."""
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
