"""Record a filter in your own loop and watch it on the page.

python examples/05_live.py [WORKSPACE]; in another terminal: beliefscope serve --workspace WORKSPACE
"""

import sys
import time
from pathlib import Path

import torch

from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.batch import single_step
from beliefscope.filters.belief import Gaussian
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.recordings.live import LiveRecorder

with open_dataset(sample_path("door")) as data:
    robot = data[9]  # replaces a robot: step t has the observations at that time
checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-ekf"))
filter_, generator = checkpoint.filter, torch.Generator().manual_seed(0)
first = filter_.statistics.standardise("state", torch.from_numpy(robot.states[:1]))
start = Gaussian(first, 0.1 * torch.eye(filter_.n)[None])

folder = Path(sys.argv[1] if len(sys.argv) > 1 else "workspace") / "live"
belief = filter_.start(start, 300, generator)
with torch.no_grad(), LiveRecorder("example", checkpoint, folder=folder, start=start) as live:
    for t in range(len(robot)):
        observations, control = {key: array[t] for key, array in robot.observations.items()}, robot.controls[t]
        evidence = filter_.encode(single_step(filter_.task, observations, control))[0]
        belief, step_trace = filter_.step(belief, evidence, generator)
        live.step(step_trace, observations, control, truth=robot.states[t], evidence=evidence)  # truth is optional
        time.sleep(robot.dt)

estimate = filter_.statistics.state_to_si(step_trace.estimate.mean)[0].numpy()
print(f"{live.path}: {live.steps} steps, the hinge is at ({100 * estimate[0]:.1f}, {100 * estimate[1]:.1f}) cm")
