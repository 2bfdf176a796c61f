"""Run all fast diagnostics on a filter under 40 % image blackout.

python examples/01_diagnose.py [DIR]; DIR: folder for the figures.
"""

import sys
from pathlib import Path

from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.inspect.catalog import DIAGNOSTICS
from beliefscope.inspect.diagnostics.plotting import write_figure
from beliefscope.inspect.trace import trace

checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-pf"))
faults = Faults.parse("blackout=0.4")  # 40 % image blackout
with open_dataset(sample_path("door")) as data:
    traces = [trace(checkpoint, data[i], i, faults=faults) for i in data.held_out()[:5]]

for name, entry in DIAGNOSTICS.items():
    refusal = entry.refusal(traces[0], checkpoint)
    print(f"\n{entry.title}. {entry.question}")
    if refusal or entry.slow:
        print(f"  Skipped: {refusal or 'slow'}.")
        continue
    diagnostic = entry(traces, checkpoint)
    print(f"  {diagnostic.verdict}")
    print("  Tables:", ", ".join(table.title for table in diagnostic.tables()))
    if len(sys.argv) > 1:
        single = entry(traces[:1], checkpoint)  # a single trace has curves over its steps
        write_figure(single.plot(), Path(sys.argv[1]) / f"{name}.pdf")
