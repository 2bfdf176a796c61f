"""Hostile input: every reader of files, every HTTP route and the view's socket, given many wrong inputs.

    python bench/fuzz.py [part ...] --inputs 10000 --seed 0 --keep DIR

Parts are ``http``, ``socket`` and the readers in tests/fuzz/readers.py; all by default. Files are read in processes of
their own, whose memory is bounded and which are ended when one input takes too long: what kills such a process is a
failure, and the rest goes on. Inputs that fail are kept in DIR, with what came of them. Exit code 1 where any did.
"""

from __future__ import annotations

import argparse
import mmap
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "fuzz"))

MEMORY = 1 << 30  # bytes that reading may take beyond what the process has
PATIENCE = 5  # s of processor time for one input
IN_A_ROW = (
    1000  # inputs of one process: glibc reserves, and never gives back, 64 MB at each request that it must refuse
)


@dataclass
class Outcome:
    """What came of the inputs of one part."""

    inputs: int = 0
    read: int = 0
    refused: int = 0
    seconds: float = 0.0
    failures: Counter[str] = field(default_factory=Counter)

    def row(self, name: str) -> str:
        failed = sum(self.failures.values())
        return f"| {name} | {self.inputs} | {self.refused} | {self.read} | {failed} | {self.seconds:.0f} |"


def fuzz_reader(name: str, inputs: int, seed: int, keep: Path) -> Outcome:
    """All inputs of one reader, in as many processes as it takes."""
    import readers

    from beliefscope.app.cli.options import recording_in
    from beliefscope.datasets.errors import BadInput
    from beliefscope.datasets.store import open_dataset

    outcome = Outcome(inputs)
    began = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        readers.check_whole(name, Path(folder))  # and fills the caches
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder, mmap.mmap(-1, 32) as shared:

        def kept(number: int, why: str) -> None:
            outcome.failures[why.splitlines()[-1][:160]] += 1
            with readers.spoiled(name, seed, number, Path(folder)) as path:
                place = keep / f"{name.replace(' ', '-')}-{number}"
                place.mkdir(parents=True, exist_ok=True)
                for left in Path(folder).glob(f"{path.stem}.*"):
                    shutil.copy(left, place)
                (place / "why.txt").write_text(why)

        def contained(number: int) -> bool:
            """Some damaged files end the process that reads them. Nobody reads one before another process has."""
            with readers.spoiled(name, seed, number, Path(folder)) as path:
                try:
                    (open_dataset if name in readers.HDF5 else recording_in)(path)
                except BadInput:
                    return True
            return False

        with readers.spoiled(name, seed, 0, Path(folder)):
            pass  # makes the valid file here: Rerun writes none in a fork
        first = 0
        while first < inputs:
            errors = Path(folder) / "errors"
            errors.mkdir(exist_ok=True)
            last = min(first + IN_A_ROW, inputs)
            code = _in_a_process(lambda first=first, last=last: _read_all(name, seed, first, last, folder, shared))  # type: ignore[misc]
            at, read, refused = (int.from_bytes(shared[i : i + 8], "little") for i in (0, 8, 16))
            outcome.read, outcome.refused = outcome.read + read, outcome.refused + refused
            for error in errors.iterdir():
                kept(int(error.name), error.read_text())
                error.unlink()
            first = at + 1 if code else last
            if code < 0 and name in ("recording", *readers.HDF5) and contained(at):
                outcome.refused += 1
            elif code:
                kept(at, f"ended by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}")
    outcome.seconds = time.monotonic() - began
    return outcome


def _read_all(name: str, seed: int, first: int, last: int, folder: str, shared: mmap.mmap) -> None:
    """In the process, which itself is the one that goes over a file first. Counts in shared memory outlive it."""
    import readers

    from beliefscope.datasets.readers import hdf5_guard

    hdf5_guard.is_foreign = lambda path: False
    with open("/proc/self/statm") as file:
        taken = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY, taken + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    counts = {"read": 0, "refused": 0}
    for number in range(first, last):
        shared[0:8] = number.to_bytes(8, "little")
        signal.setitimer(signal.ITIMER_PROF, PATIENCE)  # SIGPROF ends a process that does not care
        try:
            counts[readers.attempt(name, seed, number, Path(folder))] += 1
        except BaseException as error:
            why = "".join(traceback.format_exception(error))
            (Path(folder) / "errors" / str(number)).write_text(why.encode(errors="replace").decode())
        shared[8:24] = counts["read"].to_bytes(8, "little") + counts["refused"].to_bytes(8, "little")


def fuzz_server(name: str, inputs: int, seed: int, keep: Path) -> Outcome:
    """All inputs of the HTTP routes, or of a view's socket; then what they left behind."""
    import threading

    import asked
    import readers

    began, before = time.monotonic(), threading.active_count()
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        given = readers.server(Path(folder))
        with asked.served(given) as (client, heard):
            ask = asked.ask_http if name == "http" else asked.ask_socket
            tally = ask(client, heard, inputs, seed)
        for left in asked.left_over(given.workspace):
            tally.failures[f"left over: {left}"] = ""
        if more := asked.threads_after(before):
            tally.failures[f"{more} threads are left"] = ""
    place = keep / name
    for number, (why, sent) in enumerate(tally.failures.items()):
        place.mkdir(parents=True, exist_ok=True)
        (place / f"{number}.txt").write_text(f"{why}\n{sent}\n", errors="replace")
    print(f"    {name}: {dict(tally.answers)}", file=sys.stderr)
    good = tally.answers["2xx"] + tally.answers["maps"] + tally.answers["drawn"]
    failures = Counter(dict.fromkeys((why[:160] for why in tally.failures), 1))
    return Outcome(tally.inputs, good, tally.inputs - good, time.monotonic() - began, failures)


SERVER = ("http", "socket")


def _in_a_process(work: Callable[[], None]) -> int:
    """Its exit code; minus the signal that ended it."""
    pid = os.fork()
    if pid:
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)  # libraries print what they think of a file
    os.dup2(null, 1)
    code = 70
    try:
        work()
        code = 0
    finally:
        os._exit(code)


def main() -> None:
    import readers

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = [*readers.READERS, *SERVER]
    parser.add_argument("parts", nargs="*", metavar="part", help=f"some of: {', '.join(parts)}")
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path("fuzz-failures"))
    given = parser.parse_args()
    if unknown := set(given.parts) - set(parts):
        parser.error(f"part {min(unknown)!r} does not exist. Available: {', '.join(parts)}")
    print("| part | inputs | refused | read | failures | seconds |\n| --- | ---: | ---: | ---: | ---: | ---: |")
    failed = False
    for name in given.parts or parts:
        fuzz = fuzz_server if name in SERVER else fuzz_reader
        outcome = fuzz(name, given.inputs, given.seed, given.keep)
        print(outcome.row(name), flush=True)
        for why, count in outcome.failures.most_common():
            print(f"    {count} x {why}", file=sys.stderr, flush=True)
        failed |= bool(outcome.failures)
    sys.exit(failed)


if __name__ == "__main__":
    main()
