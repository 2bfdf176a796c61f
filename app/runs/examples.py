"""Examples that the page offers: runs that show one thing each."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from urllib.parse import parse_qs

from beliefscope.app.runs.catalog import TaskCatalog


@dataclass(frozen=True)
class Example:
    """A run on the page.

    Attributes:
        help: what it shows. link: query string of the page's address.
        setup: shell command that serves its data where they are not included; empty if this server has them.
    """

    title: str
    help: str
    link: str
    setup: str = ""

    @property
    def task(self) -> str:
        return parse_qs(self.link[1:])["task"][0]

    @property
    def filter(self) -> str:
        return parse_qs(self.link[1:])["filter"][0]


EXAMPLES = (
    Example(
        "Camera outage",
        "The camera goes dark during the first contact with a pushed object.",
        "?task=push-field&filter=information-ekf&weights=effective",
    ),
    Example(
        "Frozen image",
        "The camera repeats one image; the diagnosis names the cause.",
        "?task=push&filter=crossmodal-ekf&step=50&faults=image_frozen%3Afrom%3D30&tab=diagnosis",
    ),
    Example(
        "Biased force sensor",
        "The measured force has a bias of 8 N; the diagnosis names the cause.",
        "?task=push-field&filter=information-ekf&faults=force_bias%3Ax%3D8&tab=diagnosis",
    ),
    Example(
        "External filter",
        "A Kalman filter in plain PyTorch that uses no camera, compared with a pretrained filter.",
        "?task=door&filter=hand-on-arc&step=29&against=filter%3Dcrossmodal-ekf&tab=compare",
    ),
    Example(
        "Real push",
        "A robot pushes a steel block: forces and poses of the MIT Push data set (Yu et al., IROS 2016).",
        "?task=push-real&filter=crossmodal-pf&step=20",
        setup="beliefscope serve --data mit_push",
    ),
)
"""The first is what an address without a selection opens."""


def available(catalogs: Mapping[str, TaskCatalog]) -> Iterator[Example]:
    """The examples that can be displayed, and those with a setup. Each loads the filters of its task."""
    for example in EXAMPLES:
        catalog = catalogs.get(example.task)
        if catalog and catalog.data and not catalog.problem and example.filter in catalog.filters:
            yield replace(example, setup="")
        elif example.setup:
            yield example
