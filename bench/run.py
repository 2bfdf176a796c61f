"""All speed measurements: ``python bench/run.py [part ...]``; default: all parts.

Times vary with other load: compare values of one run only. Ratios are measured between alternating repetitions.
Nothing is asserted.
"""

from __future__ import annotations

import argparse
import os
import platform
import sys

import collect
import filters
import finetune
import live
import loading
import maps
import page
import recordings
import torch
from rich.console import Console
from rich.table import Table

PARTS = {
    "collect": collect.measure,
    "filters": filters.measure,
    "finetune": finetune.measure,
    "maps": maps.measure,
    "loading": loading.measure,
    "recordings": recordings.measure,
    "page": page.measure,
    "live": live.measure,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("parts", nargs="*", metavar="part", help=f"any of: {', '.join(PARTS)}")
    parts = parser.parse_args().parts or list(PARTS)
    unknown = set(parts) - PARTS.keys()
    if unknown:
        parser.error(f"part {min(unknown)!r} does not exist. Available: {', '.join(PARTS)}")
    console = Console(width=100)
    console.print(
        f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, "
        f"Python {platform.python_version()}, torch {torch.__version__} on {torch.get_num_threads()} threads"
    )
    for part in parts:
        table = Table("quantity", "measured", "required", title=part, title_justify="left", min_width=90)
        for quantity, measured, bar in PARTS[part]():
            table.add_row(quantity, measured, bar)
        console.print(table)
        sys.stdout.flush()


if __name__ == "__main__":
    main()
