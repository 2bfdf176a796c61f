"""What if? Break a sensor for two seconds, or set beta by hand, and run again.

python examples/02_counterfactual.py [FIGURE.pdf]; all edits are compared with one run, by common random numbers.
"""

import sys
from pathlib import Path

from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.compare.counterfactual import compare
from beliefscope.inspect.diagnostics.plotting import write_figure
from beliefscope.inspect.trace import trace
from beliefscope.inspect.traces.replay import Edit, Replay

checkpoint = load_checkpoint(shipped("push", "crossmodal-pf"))
with open_dataset(sample_path("push")) as data:
    index = data.held_out()[0]
    replay = Replay(checkpoint, trace(checkpoint, data[index], index))

black = Faults.parse("blackout")
edits = {
    "the picture is black": Edit(40, 60, black),
    "the picture is black, and beta still trusts it": Edit(40, 60, black, {"image": 1.0}),
    "the picture is good, and beta trusts touch alone": Edit(40, 60, weights={"haptics": 1.0}),
}
for what, edit in edits.items():
    found = compare(replay.original, replay.edited(edit), edit)
    print(f"\nWhat if {what}?\n  {found.verdict}")

if len(sys.argv) > 1:
    write_figure(found.plot(), Path(sys.argv[1]))
