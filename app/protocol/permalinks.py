"""Query strings that open a step on the page; ``app/page/core/state.js`` reads and writes the same format."""

from __future__ import annotations

from typing import TYPE_CHECKING
from urllib.parse import urlencode

from beliefscope.datasets.task import Task

if TYPE_CHECKING:
    from beliefscope.inspect.compare.effects import Regression


def permalink(task: Task, filter_: str, data: str, episode: int, step: int, faults: str = "", by: str = "error") -> str:
    """``?task=...&step=...``, identical to the address that the page itself shows.

    filter_, data: names on the page. by: the score that ranks the page's failures; it also selects the track of the
    timeline, the component or the kind of weights.
    """
    return page_link(
        task=task.name,
        filter=filter_,
        data=data,
        episode=episode,
        step=step,
        component=by if by in {c.name for c in task.components} else task.map_components[0],
        weights="effective" if by == "regret" else "raw",
        track={"ess": "particles", "nees": "nees"}.get(by, "error"),
        tab="scene",
        faults=faults,
        by="" if by == "error" else by,
    )


def page_link(**state: str | int | None) -> str:
    """The page's address with the parts of its state that are not empty."""
    query = {name: value for name, value in state.items() if value not in ("", None)}
    # Browsers' URLSearchParams do not encode the star and encode the tilde.
    return "?" + urlencode(query, safe="*").replace("~", "%7E")


def comparison_permalink(link: str, event: Regression, filter_: str) -> str:
    """A permalink that adds a comparison run: the one of ``filter_``, which was better at this event.

    An event with a single modality is compared with the standalone filter of this modality.
    """
    against = {"only": event.only[0]} if len(event.only) == 1 else {"filter": filter_}
    return f"{link}&{urlencode({'against': urlencode(against)})}"
