"""Addresses of moments: what follows the page's ``?`` to open one. ``page/state.js`` writes and reads the same."""

from __future__ import annotations

from urllib.parse import urlencode

from beliefscope.datasets.task import Task


def moment_link(
    task: Task, filter_: str, data: str, episode: int, step: int, recipe: str = "", by: str = "error"
) -> str:
    """``?task=...&step=...``, as the page's own address says it.

    Args:
        filter_, data: names as the page shows them. recipe: text. by: name of the score that ranks the page's list of
            failures; it chooses what the time line draws too: the angle that it is of, the particles of ``ess``, the
            normalised squared error of ``nees``, the weights as they acted of ``regret``.
    """
    kept: dict[str, str | int] = {
        "task": task.name,
        "filter": filter_,
        "data": data,
        "episode": episode,
        "step": step,
        "component": by if by in {c.name for c in task.components} else task.map_components[0],
        "weights": "acting" if by == "regret" else "raw",
        "track": {"ess": "particles", "nees": "nees"}.get(by, "error"),
        "tab": "scene",
    }
    if recipe:
        kept["recipe"] = recipe
    if by != "error":
        kept["by"] = by
    # Browsers' URLSearchParams leave the star as it is and encode the tilde.
    return "?" + urlencode(kept, safe="*").replace("~", "%7E")
