"""All speed measurements: ``python bench/run.py [part ...]``; default: all parts.

Times vary with other load: compare values of one run only. Ratios are measured between alternating repetitions.
Nothing is asserted.
"""

from __future__ import annotations

import argparse

import collect
import external
import filters
import finetune
import live
import loading
import maps
import page
import recordings
import subject

PARTS = {
    "collect": collect.measure,
    "filters": filters.measure,
    "external": external.measure,
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
    subject.print_machine()
    for part in parts:
        subject.print_table(part, subject.COLUMNS, PARTS[part]())


if __name__ == "__main__":
    main()
