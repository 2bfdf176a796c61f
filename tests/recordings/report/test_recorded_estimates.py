"""Reports of runs that were recorded by other programs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from beliefscope.datasets.episode import Episode, durations_text
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.load import as_external
from beliefscope.inspect.trace import Trace, trace
from beliefscope.recordings.report.command_lines import trace_command
from beliefscope.recordings.report.compose import scene_caption
from beliefscope.recordings.report.figures import event_figure

STEPS = 20
TASK = Task(
    name="train",
    components=(Component("x", "m"), Component("y", "m")),
    observations={"depth": (4, 6), "radar": (1,)},
    modalities={"depth": ("depth",), "radar": ("radar",)},
    control_size=0,
    dt=0.2,
    arrays=("depth",),
)


@pytest.fixture(scope="module")
def run() -> Trace:
    depth = np.random.default_rng(0).normal(5.0, 1.0, (STEPS, 4, 6))
    episode = Episode(TASK, np.zeros((STEPS, 2)), observations={"depth": depth, "radar": np.zeros((STEPS, 1))})
    still = Adapter(lambda observations, controls: np.zeros((STEPS, 2)), batched=False, initial_std=(1.0, 1.0))
    return trace(as_external(still, "still", TASK), episode)


def test_commands_import_recorded_estimates(run: Trace) -> None:
    recorded = replace(run, checkpoint_hash="", settings={"source": "my log.csv"}, episode_index=3)
    command = trace_command(recorded, "3.trace", "", None)
    assert command == "beliefscope import 'my log.csv' --map MAP.toml --episode 3 -o 3.trace"
    assert trace_command(replace(recorded, settings={}), "3.trace", "", None).startswith("# 3.trace was recorded")
    assert trace_command(run, "3.trace", "", None).startswith("beliefscope trace train")


def test_events_show_arrays_in_colours_over_the_range_of_the_run(run: Trace) -> None:
    (image,) = event_figure(run, 3, None).axes[0].images
    depth = run.episode.observations["depth"]
    np.testing.assert_array_equal(image.get_array(), depth[3])
    assert image.get_clim() == pytest.approx((depth.min(), depth.max()))


def test_captions_name_only_the_parts_of_a_figure(run: Trace) -> None:
    assert scene_caption(run, 0, False) == "From above: the true and the estimated position, and the belief"
    known = replace(run, estimate_covariance=np.tile(np.eye(2, dtype=np.float32), (STEPS, 1, 1)))
    assert scene_caption(known, 0, True).endswith("the belief over the fused map; 2 sigma contours")


def test_durations_of_irregular_steps_are_a_range(run: Trace) -> None:
    irregular = replace(run.episode, time=np.concatenate([[0.0], 0.15 + 0.2 * np.arange(STEPS - 1)]))
    assert durations_text([run.episode]) == "0.2 s each"
    assert durations_text([run.episode, irregular]) == "0.2 s each (0.15 to 0.2 s)"
