"""Ask a filter what it trusts, whether rightly, and whether its covariance is true.

python examples/01_diagnose.py [DIR]; with a folder, a figure of each answer is written there.
"""

import sys
from pathlib import Path

from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, shipped
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnostics.plotting import write_figure
from beliefscope.inspect.trace import trace

checkpoint = load_checkpoint(shipped("door", "crossmodal-pf"))
broken = Faults.parse("blackout=0.4")  # four of ten pictures are black
with open_dataset(sample_path("door")) as data:
    traces = [trace(checkpoint, data[i], i, faults=broken) for i in data.held_out()[:5]]

for name, entry in DIAGNOSTICS.items():
    why = entry.refusal(traces[0], checkpoint)
    print(f"\n{entry.title}. {entry.question}")
    if why or entry.slow:
        print(f"  Not asked: {why or 'takes a while'}.")
        continue
    found = entry(traces, checkpoint)
    print(f"  {found.verdict}")
    print("  Its tables:", ", ".join(table.title for table in found.tables()))
    if len(sys.argv) > 1:
        alone = entry(traces[:1], checkpoint)  # of one trace there are curves over its steps
        write_figure(alone.plot(), Path(sys.argv[1]) / f"{name}.pdf")
