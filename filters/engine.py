"""Engines that run a function over many items: this process, several processes, or a Ray cluster."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from typing import Any, Literal, TypeVar

import torch

from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.parallel import run_in_processes

Item = TypeVar("Item")
Result = TypeVar("Result")

Block = TypeVar("Block", bound=Sequence[Any])

Engine = Literal["local", "ray"]
Progress = Callable[[float], None] | None


def run_all(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    engine: Engine = "local",
    workers: int = 1,
    on_loss: Callable[[Item, Exception], Result] | None = None,
) -> Generator[tuple[Item, Result]]:
    """Call ``function`` with each item; yields items and results in the order they finish.

    Each call has one thread, so that results have the same bits with any engine and number of workers, and several
    calls do not compete for cores. Lost processes and machines are replaced, their items run again.

    Args:
        workers: number of processes of the local engine; 1: this process, in the order of the items.
        on_loss: result of an item whose machine or process on a Ray cluster failed after all retries. Default: raise.

    Raises what the function raises; BadInput if Ray is not installed or its cluster cannot be reached.
    """
    call = partial(_with_one_thread, function)
    if engine == "ray":
        yield from _run_on_ray(call, items, on_loss)
    elif min(workers, len(items)) <= 1:
        for item in items:
            yield item, call(item)
    else:
        with closing(run_in_processes(call, items, min(workers, len(items)))) as results:
            yield from results


def run_blocks(
    function: Callable[[Block, Progress], Result],
    blocks: Sequence[Block],
    engine: Engine = "local",
    workers: int = 1,
    progress: Progress = None,
) -> Generator[tuple[Block, Result]]:
    """As ``run_all``, for blocks of items, with the completed share of all items.

    In this process, ``function(block, progress)`` may report the share of its block; elsewhere ``progress`` is None.
    """
    total, finished = sum(map(len, blocks)), 0

    def call(block: Block) -> Result:
        return function(block, lambda share: report(share * len(block)))

    def report(items: float) -> None:
        if progress is not None:
            progress((finished + items) / total)

    here = engine == "local" and min(workers, len(blocks)) <= 1
    for block, result in run_all(call if here else partial(_silent, function), blocks, engine, workers):
        finished += len(block)
        report(0)
        yield block, result


def _silent(function: Callable[[Block, Progress], Result], block: Block) -> Result:
    return function(block, None)


def _run_on_ray(
    function: Callable[[Item], Result], items: Sequence[Item], on_loss: Callable[[Item, Exception], Result] | None
) -> Generator[tuple[Item, Result]]:
    """As ``run_all`` on a Ray cluster, each call with one CPU and, if the cluster has any, one GPU.

    The cluster is that of ``RAY_ADDRESS``, else one that runs on this machine, else a temporary one. All its machines
    need this package, and the files of the items at the same path.
    """
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # Ray sends usage statistics by default
    try:
        import ray
    except ImportError:
        raise BadInput("engine 'ray' needs Ray: pip install 'beliefscope[ray]'") from None
    started = not ray.is_initialized()
    if started:
        quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
        try:
            ray.init("auto", **quiet)
        except (ConnectionError, RuntimeError, ValueError) as error:
            if address := os.environ.get("RAY_ADDRESS"):
                raise BadInput(f"engine 'ray' reaches no cluster at RAY_ADDRESS {address!r}: {error}") from None
            ray.init("local", include_dashboard=False, **quiet)
    try:
        gpus = min(1, ray.cluster_resources().get("GPU", 0))
        # Ray takes functions only, no other callables such as partial ones.
        run: Any = ray.remote(num_cpus=1, num_gpus=gpus, max_retries=3)(lambda item: function(item))
        running = {run.remote(item): item for item in items}
        while running:
            (done, *_), _ = ray.wait(list(running))
            item = running.pop(done)
            try:
                result = ray.get(done)
            except ray.exceptions.RayTaskError as error:
                raise error.cause from None
            except ray.exceptions.RayError as error:
                if on_loss is None:
                    raise
                result = on_loss(item, error)
            yield item, result
    finally:
        if started:
            ray.shutdown()


@contextmanager
def one_thread() -> Iterator[None]:
    """Run torch operations in one thread."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _with_one_thread(function: Callable[[Item], Result], item: Item) -> Result:
    with one_thread():
        return function(item)
