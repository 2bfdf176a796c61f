"""Everything that is timed, in one run: ``python bench/run.py [part ...]``, parts as named below; all by default.

Times on a busy machine wander; what is to be compared stands in one run, and ratios are taken between turns that
alternate. Nothing here is asserted: the figures are for reading.
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
    parser.add_argument("parts", nargs="*", metavar="part", help=f"some of: {', '.join(PARTS)}")
    wanted = parser.parse_args().parts or list(PARTS)
    unknown = set(wanted) - PARTS.keys()
    if unknown:
        parser.error(f"part {min(unknown)!r} does not exist. Available: {', '.join(PARTS)}")
    console = Console(width=100)
    console.print(
        f"{platform.machine()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, "
        f"Python {platform.python_version()}, torch {torch.__version__} on {torch.get_num_threads()} threads"
    )
    for part in wanted:
        table = Table("what", "measured", "bar", title=part, title_justify="left", min_width=90)
        for what, measured, bar in PARTS[part]():
            table.add_row(what, measured, bar)
        console.print(table)
        sys.stdout.flush()


if __name__ == "__main__":
    main()
