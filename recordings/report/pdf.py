"""Prints a page as PDF with an installed Chromium."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import tempfile
from pathlib import Path

from beliefscope.datasets.errors import BadInput

BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
TIMEOUT = 180  # s
FLAGS = ("--headless", "--disable-gpu", "--no-first-run", "--disable-extensions", "--no-pdf-header-footer")


def browser() -> str:
    """Path of a Chromium: ``BELIEFSCOPE_CHROMIUM``, or one in PATH. Raises BadInput if there is none."""
    path = os.environ.get("BELIEFSCOPE_CHROMIUM") or next(filter(None, map(shutil.which, BROWSERS)), None)
    if path is None:
        raise BadInput("PDF output requires Chromium: install it, or set BELIEFSCOPE_CHROMIUM to its path")
    return path


def print_page(chromium: str, page: Path, pdf: Path) -> None:
    """Print the page, with dates in the PDF set to zero. Raises BadInput if the browser fails."""
    # Chromium's own sandbox does not start as root.
    root = ["--no-sandbox"] if os.geteuid() == 0 else []
    with tempfile.TemporaryDirectory() as profile:
        command = [chromium, *FLAGS, *root, f"--user-data-dir={profile}", f"--print-to-pdf={pdf}", page.as_uri()]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise BadInput(f"{chromium} did not print the report: {error}") from None
    if done.returncode or not pdf.is_file():
        reason = (done.stderr.strip().splitlines() or ["no reason given"])[-1]
        raise BadInput(f"{chromium} did not print the report: {reason}")
    # Same length, so that the offsets in the file remain valid.
    pdf.write_bytes(
        re.sub(rb"\(D:[^)]{4,}\)", lambda date: b"(D:" + date[0][3:-1].translate(ZEROS) + b")", pdf.read_bytes())
    )


ZEROS = bytes(ord("0") if ord("1") <= value <= ord("9") else value for value in range(256))
