"""Addresses of moments: what follows the page's ``?`` to open one. ``page/state.js`` writes and reads the same."""

from __future__ import annotations

from typing import TYPE_CHECKING
from urllib.parse import urlencode

from beliefscope.datasets.task import Task

if TYPE_CHECKING:
    from beliefscope.inspect.compare.effects import Worsening


def moment_link(
    task: Task, filter_: str, data: str, episode: int, step: int, faults: str = "", by: str = "error"
) -> str:
    """``?task=...&step=...``, as the page's own address says it.

    Args:
        filter_, data: names as the page shows them. faults: text. by: name of the score that ranks the page's list of
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
    if faults:
        kept["faults"] = faults
    if by != "error":
        kept["by"] = by
    # Browsers' URLSearchParams leave the star as it is and encode the tilde.
    return "?" + urlencode(kept, safe="*").replace("~", "%7E")


def beside(link: str, moment: Worsening, other: str, weighed: bool) -> str:
    """A moment's link that shows another run beside: the one of the filter ``other``, which it got worse than.

    A moment of one modality alone is shown by the same filter with all of beta on that one, where it is ``weighed``.
    """
    against: dict[str, str | int] = {"filter": other}
    if weighed and len(moment.only) == 1:
        against = {"from": 0, "to": moment.last + 1, "weights": f"{moment.only[0]}=1"}
    return f"{link}&{urlencode({'against': urlencode(against)})}"
