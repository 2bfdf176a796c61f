"""Layout of recordings."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from beliefscope.datasets.simulation.door import DOOR
from beliefscope.inspect.trace import Trace
from beliefscope.recordings.rerun_log.blueprint import blueprint
from beliefscope.recordings.rerun_log.entities import columns


def views(part: Any) -> Iterator[Any]:
    yield part
    for inner in getattr(part, "contents", None) or ():
        if not isinstance(inner, str):
            yield from views(inner)


def test_the_view_of_the_belief_follows_an_estimate_that_exists_from_the_first_step(
    new_trace: Callable[..., Trace],
) -> None:
    trace = new_trace("ekf")
    (belief,) = (v for v in views(blueprint(trace, DOOR).root_container) if str(v.name).startswith("Belief"))
    (tracked,) = belief.properties["EyeControls3D"].tracking_entity.as_arrow_array().to_pylist()
    assert tracked in dict(columns(trace, DOOR, slice(0, 1)))


def test_negative_variances_have_no_warnings(new_trace: Callable[..., Trace]) -> None:
    """As those of a filter whose updates reduce the covariance too much."""
    trace = new_trace("ekf")
    covariance = trace.estimate_covariance.copy()
    covariance[3] *= -1.0
    negative = replace(trace, estimate_covariance=covariance)
    with np.errstate(invalid="raise"):
        blueprint(negative, DOOR)
        bands = dict(columns(negative, DOOR, slice(0, len(trace))))
    assert bands
