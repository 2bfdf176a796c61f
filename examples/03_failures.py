"""Find where a shipped filter fails, and where its modalities part: python examples/03_failures.py [FIGURE.pdf]"""

import sys
from pathlib import Path

from beliefscope.app.protocol.permalinks import moment_link
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.diagnostics.plotting import write_figure
from beliefscope.inspect.failures.moments import find_failures

checkpoint = load_checkpoint(shipped("push", "crossmodal-pf"))
with open_dataset(sample_path("push")) as data:
    found = find_failures(checkpoint, data, by="disagreement")

print(found.verdict)
for moment in found.worst(5):
    print(f"{found.shown(moment.score):>12}  {moment.group:<15} fused {100 * moment.error[-1]:.1f} cm off the truth")
    print("  ", moment_link(checkpoint.task, "crossmodal-pf", "sample", moment.episode, moment.step, by=found.by))

if len(sys.argv) > 1:
    write_figure(found.plot(), Path(sys.argv[1]))
