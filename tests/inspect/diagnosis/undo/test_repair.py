"""Smallest repairs of planted failures, compared with an exhaustive search over all intervals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.checkpoint import PRETRAINED, load_checkpoint
from beliefscope.inspect.diagnosis.undo.repair import (
    MAX_REPLAYS,
    Candidate,
    Candidates,
    largest_failure,
    smallest_repair,
)
from beliefscope.inspect.statistics.measures import main_error
from beliefscope.inspect.trace import Trace, trace

STEPS, PARTICLES = 46, 50


def case(name: str, index: int, faults: str) -> tuple[Episode, Trace, float]:
    """A short clean episode, the trace of a faulty copy, and a bound of the error."""
    with open_dataset(f"datasets/samples/{name.split('-')[0]}.h5") as data:
        full = data[index]
    observations = {key: values[:STEPS] for key, values in full.observations.items()}
    arrays = {key: getattr(full, key)[:STEPS] for key in ("states", "controls", "contact", "qpos")}
    clean = replace(full, observations=observations, **arrays)
    checkpoint = load_checkpoint(PRETRAINED / f"{name}.safetensors")
    healthy = trace(checkpoint, clean, particles=PARTICLES)
    bound = 1.5 * float(main_error(healthy)[30:, -1].max())
    return clean, trace(checkpoint, Faults.parse(faults).apply(clean), particles=PARTICLES), bound


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "index", "faults"),
    [
        ("door-crossmodal-ekf", 141, "image_occluded=16:gray=255:x=8:y=8:from=35:to=41"),
        ("push-crossmodal-pf", 142, "image_occluded=16:gray=255:x=8:y=8:from=36:to=42"),
    ],
)
@pytest.mark.parametrize("restorable", [True, pytest.param(False, marks=pytest.mark.long)])
@pytest.mark.long
def test_no_shorter_repair_exists(name: str, index: int, faults: str, restorable: bool) -> None:
    clean, run, bound = case(name, index, faults)
    checkpoint = load_checkpoint(PRETRAINED / f"{name}.safetensors")
    result = smallest_repair(checkpoint, run, bound, clean if restorable else None)
    assert result is not None
    assert result.replays <= MAX_REPLAYS
    search = Candidates(checkpoint, run, result.failure, clean if restorable else None)
    end = result.failure[1] + 1
    every = [
        Candidate((sensor,), restored, first, to)
        for sensor in ("image", "haptics")
        for restored in ((False, True) if restorable else (False,))
        for first in range(30, end)
        for to in range(first + 1, end + 1)
    ]
    errors = search.errors(every)
    repairing = [candidate for candidate, error in zip(every, errors, strict=True) if error <= bound]
    if result.candidate is None:
        assert not repairing
        return
    assert len(result.candidate.sensors) == 1
    assert result.candidate.steps == min(candidate.steps for candidate in repairing)
    assert result.repaired <= bound < result.error


def test_restoring_the_planted_steps_gives_the_clean_run() -> None:
    """Also for particles: replays have the random numbers of the run."""
    for name in ("door-crossmodal-ekf", "push-crossmodal-pf"):
        clean, run, _ = case(name, 141, "delay=haptics:steps=6:from=35:to=42,image_noise=60:from=35:to=42")
        checkpoint = load_checkpoint(PRETRAINED / f"{name}.safetensors")
        search = Candidates(checkpoint, run, (38, 45), clean)
        both = Candidate(("image", "haptics"), True, 33, 45)
        expected = main_error(trace(checkpoint, clean, particles=PARTICLES))[38:46, -1]
        assert search.errors([both])[0] == pytest.approx(np.sqrt(np.square(expected).mean()), rel=1e-3)
        nothing = Candidate(("image",), True, 0, 1)
        original = main_error(run)[38:46, -1]
        assert search.errors([nothing])[0] == pytest.approx(np.sqrt(np.square(original).mean()), rel=1e-3)


def test_runs_below_the_bound_have_no_failure() -> None:
    _, run, _ = case("door-crossmodal-ekf", 141, "")
    assert largest_failure(run, 1.0) is None
    assert smallest_repair(load_checkpoint(PRETRAINED / "door-crossmodal-ekf.safetensors"), run, 1.0) is None
