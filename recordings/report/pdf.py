"""Prints a page as PDF with a Chromium that is installed."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

from beliefscope.datasets.errors import BadInput

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
PATIENCE = 180  # s
FLAGS = ("--headless", "--disable-gpu", "--no-first-run", "--disable-extensions", "--no-pdf-header-footer")


def browser() -> str:
    """Path of a Chromium: ``BELIEFSCOPE_CHROMIUM``, or one on the path. Raises BadInput where there is none."""
    found = os.environ.get("BELIEFSCOPE_CHROMIUM") or next(filter(None, map(shutil.which, BROWSERS)), None)
    if found is None:
        raise BadInput("no Chromium to print with: install it, or give its path in BELIEFSCOPE_CHROMIUM")
    return found


def print_page(chromium: str, page: Path, pdf: Path) -> None:
    """Raises BadInput where the browser does not print it. The dates that it writes into the file are taken out."""
    # Chromium's own sandbox does not start as root.
    root = ["--no-sandbox"] if os.geteuid() == 0 else []
    with tempfile.TemporaryDirectory() as profile:
        command = [chromium, *FLAGS, *root, f"--user-data-dir={profile}", f"--print-to-pdf={pdf}", page.as_uri()]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise BadInput(f"{chromium} did not print the report: {error}") from None
    if done.returncode or not pdf.is_file():
        said = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise BadInput(f"{chromium} did not print the report: {said}")
    # Of the same length, so that the offsets in the file stay true.
    pdf.write_bytes(
        re.sub(rb"\(D:[^)]{4,}\)", lambda date: b"(D:" + date[0][3:-1].translate(ZEROS) + b")", pdf.read_bytes())
    )


ZEROS = bytes(ord("0") if ord("1") <= value <= ord("9") else value for value in range(256))
