"""Fuzzing of every file reader, every HTTP route and the view's socket with invalid input.

    python tools/stress/fuzz.py [part ...] --inputs 10000 --seed 0 --keep DIR

Parts are ``http``, ``socket`` and the readers in tests/fuzz/file_readers.py; default: all. Files are read in
subprocesses with limited memory and time per input; a crash of a subprocess counts as a failure. Failing inputs are
saved in DIR with the error. Exit code 1 if any input fails.
"""

from __future__ import annotations

import argparse
import mmap
import os
import resource
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
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "fuzz"))

MEMORY = 1 << 30  # bytes a reader may allocate
TIMEOUT = 5  # s of CPU time per input
BATCH = 1000  # inputs per subprocess: glibc reserves 64 MB of address space at each failed allocation


@dataclass
class Outcome:
    """Counts for one part."""

    inputs: int = 0
    read: int = 0
    refused: int = 0
    seconds: float = 0.0
    failures: Counter[str] = field(default_factory=Counter)

    def row(self, name: str) -> str:
        failed = sum(self.failures.values())
        return f"| {name} | {self.inputs} | {self.refused} | {self.read} | {failed} | {self.seconds:.0f} |"


def fuzz_reader(name: str, inputs: int, seed: int, keep: Path) -> Outcome:
    """Run all inputs of one reader, in subprocesses."""
    import file_readers

    from beliefscope.datasets.errors import BadInput
    from beliefscope.datasets.store import open_dataset
    from beliefscope.recordings.log_readers.columns import preview_columns
    from beliefscope.recordings.open_trace import open_recording

    guarded = {"recording": open_recording, "log-rerun": preview_columns} | dict.fromkeys(
        file_readers.HDF5, open_dataset
    )
    outcome = Outcome(inputs)
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        file_readers.check_valid(name, Path(folder))  # also fills the caches
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder, mmap.mmap(-1, 32) as shared:

        def save_failure(number: int, error: str) -> None:
            outcome.failures[error.splitlines()[-1][:160]] += 1
            with file_readers.corrupted(name, seed, number, Path(folder)) as path:
                target = keep / f"{name.replace(' ', '-')}-{number}"
                target.mkdir(parents=True, exist_ok=True)
                for file in Path(folder).glob(f"{path.stem}.*"):
                    file_readers.copy(file, target / file.name)
                (target / "error.txt").write_text(error)

        def is_contained(number: int) -> bool:
            """Whether the package refuses a file that crashes its reader, because a subprocess reads it first."""
            with file_readers.corrupted(name, seed, number, Path(folder)) as path:
                try:
                    guarded[name](path)
                except BadInput:
                    return True
            return False

        with file_readers.corrupted(name, seed, 0, Path(folder)):
            pass  # creates the valid file in this process, because Rerun cannot write in a fork
        first = 0
        while first < inputs:
            errors = Path(folder) / "errors"
            errors.mkdir(exist_ok=True)
            last = min(first + BATCH, inputs)
            code = _run_forked(lambda first=first, last=last: _read_all(name, seed, first, last, folder, shared))  # type: ignore[misc]
            at, read, refused = (int.from_bytes(shared[i : i + 8], "little") for i in (0, 8, 16))
            outcome.read, outcome.refused = outcome.read + read, outcome.refused + refused
            for error in errors.iterdir():
                save_failure(int(error.name), error.read_text())
                error.unlink()
            first = at + 1 if code else last
            if code < 0 and name in guarded and is_contained(at):
                outcome.refused += 1
            elif code:
                save_failure(at, f"ended by {signal.Signals(-code).name}" if code < 0 else f"exit code {code}")
    outcome.seconds = time.monotonic() - start
    return outcome


def _read_all(name: str, seed: int, first: int, last: int, folder: str, shared: mmap.mmap) -> None:
    """Read inputs in a forked process, without the probe subprocess. Counts are in shared memory."""
    import file_readers

    from beliefscope.datasets.readers import hdf5_guard

    hdf5_guard.needs_probe = lambda path: False
    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, used + MEMORY))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    counts = {"read": 0, "refused": 0}
    for number in range(first, last):
        shared[0:8] = number.to_bytes(8, "little")
        signal.setitimer(signal.ITIMER_PROF, TIMEOUT)  # SIGPROF terminates the process
        try:
            counts[file_readers.attempt(name, seed, number, Path(folder))] += 1
        except BaseException as error:
            text = "".join(traceback.format_exception(error))
            (Path(folder) / "errors" / str(number)).write_text(text.encode(errors="replace").decode())
        shared[8:24] = counts["read"].to_bytes(8, "little") + counts["refused"].to_bytes(8, "little")


def fuzz_server(name: str, inputs: int, seed: int, keep: Path) -> Outcome:
    """Run all inputs of the HTTP routes or of a view's socket, then check for leaked files and threads."""
    import threading

    import file_readers
    import http_fuzz

    start, before = time.monotonic(), threading.active_count()
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        server_settings = file_readers.server_settings(Path(folder))
        with http_fuzz.running_server(server_settings) as (client, log):
            run = http_fuzz.fuzz_http if name == "http" else http_fuzz.fuzz_socket
            tally = run(client, log, inputs, seed)
        for file in http_fuzz.temporary_files(server_settings.workspace):
            tally.failures[f"file left: {file}"] = ""
        if threads := http_fuzz.extra_threads(before):
            tally.failures[f"{threads} threads left"] = ""
    failure_folder = keep / name
    for number, (error, sent) in enumerate(tally.failures.items()):
        failure_folder.mkdir(parents=True, exist_ok=True)
        (failure_folder / f"{number}.txt").write_text(f"{error}\n{sent}\n", errors="replace")
    print(f"    {name}: {dict(tally.answers)}", file=sys.stderr)
    good = tally.answers["2xx"] + tally.answers["maps"] + tally.answers["drawn"]
    failures = Counter(dict.fromkeys((error[:160] for error in tally.failures), 1))
    return Outcome(tally.inputs, good, tally.inputs - good, time.monotonic() - start, failures)


SERVER = ("http", "socket")


def _run_forked(work: Callable[[], None]) -> int:
    """Run in a forked process; return its exit code, or minus the signal that ended it."""
    pid = os.fork()
    if pid:
        return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 2)  # libraries print warnings about files
    os.dup2(null, 1)
    code = 70
    try:
        work()
        code = 0
    finally:
        os._exit(code)


def main() -> None:
    import file_readers

    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = [*file_readers.READERS, *SERVER]
    parser.add_argument("parts", nargs="*", metavar="part", help=f"any of: {', '.join(parts)}")
    parser.add_argument("--inputs", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--keep", type=Path, default=Path("fuzz-failures"))
    args = parser.parse_args()
    if unknown := set(args.parts) - set(parts):
        parser.error(f"part {min(unknown)!r} does not exist. Available: {', '.join(parts)}")
    print("| part | inputs | refused | read | failures | seconds |\n| --- | ---: | ---: | ---: | ---: | ---: |")
    failed = False
    for name in args.parts or parts:
        fuzz = fuzz_server if name in SERVER else fuzz_reader
        outcome = fuzz(name, args.inputs, args.seed, args.keep)
        print(outcome.row(name), flush=True)
        for error, count in outcome.failures.most_common():
            print(f"    {count} x {error}", file=sys.stderr, flush=True)
        failed |= bool(outcome.failures)
    sys.exit(failed)


if __name__ == "__main__":
    main()
