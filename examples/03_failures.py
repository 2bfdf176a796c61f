"""Rank the events at which the modalities of a filter disagree: python examples/03_failures.py [FIGURE.pdf]"""

import sys
from pathlib import Path

from beliefscope.app.protocol.permalinks import permalink
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.diagnostics.plotting import write_figure
from beliefscope.inspect.failures import find_failures

checkpoint = load_checkpoint(pretrained_path("push", "crossmodal-pf"))
with open_dataset(sample_path("push")) as data:
    failures = find_failures(checkpoint, data, by="disagreement")

print(failures.verdict)
for event in failures.worst(5):
    print(f"{failures.format(event.score):>12}  {event.phase:<15} fused error {100 * event.error[-1]:.1f} cm")
    print("  ", permalink(checkpoint.task, "crossmodal-pf", "sample", event.episode, event.step, by=failures.by))

if len(sys.argv) > 1:
    write_figure(failures.plot(), Path(sys.argv[1]))
