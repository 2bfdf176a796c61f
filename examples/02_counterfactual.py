"""Counterfactuals: black out the image for two seconds, or override beta, and compare with the original run.

python examples/02_counterfactual.py [FIGURE.pdf]; all runs use the same random numbers.
"""

import sys
from pathlib import Path

from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.compare.counterfactual import compare
from beliefscope.inspect.diagnostics.plotting import write_figure
from beliefscope.inspect.trace import trace
from beliefscope.inspect.traces.replay import Intervention, Replay

checkpoint = load_checkpoint(pretrained_path("push", "crossmodal-pf"))
with open_dataset(sample_path("push")) as data:
    index = data.held_out()[0]
    replay = Replay(checkpoint, trace(checkpoint, data[index], index))

blackout = Faults.parse("blackout")
interventions = {
    "image blackout": Intervention(40, 60, blackout),
    "image blackout with all weight on image": Intervention(40, 60, blackout, {"image": 1.0}),
    "clean image with all weight on haptics": Intervention(40, 60, weights={"haptics": 1.0}),
}
for title, intervention in interventions.items():
    difference = compare(replay.original, replay.with_intervention(intervention), intervention)
    print(f"\n{title.capitalize()}\n  {difference.verdict}")

if len(sys.argv) > 1:
    write_figure(difference.plot(), Path(sys.argv[1]))
