"""Examples that the page offers: runs that show one thing each."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from urllib.parse import parse_qs

from beliefscope.app.runs.catalog import TaskCatalog


@dataclass(frozen=True)
class Example:
    """A run on the page. help: what it shows. link: query string of the page's address."""

    title: str
    help: str
    link: str

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
        "Outage at a door",
        "The camera goes dark while a hand opens a door.",
        "?task=door-field&filter=information-ekf&weights=effective",
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
        "A Kalman filter in plain PyTorch that uses no camera, compared with an included filter.",
        "?task=door&filter=hand-on-arc&step=29&against=filter%3Dcrossmodal-ekf&tab=compare",
    ),
)
"""The first is what an address without a selection opens."""


def available(catalogs: Mapping[str, TaskCatalog]) -> Iterator[Example]:
    """The examples whose task and filter can be displayed. Each loads the filters of its task."""
    for example in EXAMPLES:
        catalog = catalogs.get(example.task)
        if catalog and not catalog.problem and example.filter in catalog.filters:
            yield example
