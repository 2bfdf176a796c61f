"""Selection of a filter run: task, filter, data set, episode, sensor faults and intervention."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Self
from urllib.parse import parse_qsl

from beliefscope.app.protocol.permalinks import page_link
from beliefscope.datasets.errors import BadInput, check_name
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.inspect.traces.replay import Intervention

FILE_STEM_LENGTH = 150  # characters of task and filter in a file name


@dataclass(frozen=True)
class Selection:
    """One filter run.

    data: name of the data set; empty for the first data set of the task. intervention: over some of its
    steps. only: the only modality that a standalone run uses; empty for all modalities.
    """

    task: str
    filter: str
    episode: int
    faults: Faults = NO_FAULTS
    data: str = ""
    intervention: Intervention | None = None
    only: str = ""

    def describe(self, scope: str = "") -> str:
        """The run in words, for titles. scope: episodes, by default that of the run."""
        run = f"{self.filter}, {self.task}{f', {scope}' if scope else f' episode {self.episode}'}"
        return run + (f", {self.faults}" if self.faults else "")

    def link(self, tab: str, **state: str | None) -> str:
        """The page's address that shows the run in a tab, with other parts of the page's state."""
        run = {"task": self.task, "filter": self.filter, "data": self.data, "faults": str(self.faults)}
        return page_link(**run, episode=self.episode, **state, tab=tab)

    @property
    def file_stem(self) -> str:
        """Start of the names of the run's files. Replaces unsafe characters of the filter's name."""
        name = re.sub(r"[^A-Za-z0-9_.+-]", "-", f"{self.task}-{self.filter}")
        return f"{name[:FILE_STEM_LENGTH]}-episode{self.episode}"

    def to_json(self) -> dict[str, Any]:
        """The selection as JSON values."""
        values = {**vars(self), "faults": self.faults.to_json()}
        intervention = values.pop("intervention")
        return {**values, "edit": None if intervention is None else intervention.to_json()}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Self:
        """Inverse of ``to_json``."""
        rest = {key: value for key, value in values.items() if key != "edit"}
        intervention = None if values["edit"] is None else Intervention.from_json(values["edit"])
        return cls(**{**rest, "faults": Faults.from_json(values["faults"]), "intervention": intervention})

    def comparison(self, text: str) -> Selection:
        """The comparison run that ``text`` describes by its differences from this run.

        Args:
            text: ``filter=NAME``, ``faults=FAULTS`` (empty for clean sensors) or both; or ``only=MODALITY``, the
                standalone filter of a modality (``inspect/standalone.py``); or an intervention, ``from=20&to=40`` with
                ``faults=FAULTS``, ``weights=MODALITY=BETA`` or both.

        Raises:
            BadInput: the text has another part or describes the same run.
        """
        parts = dict(parse_qsl(text, keep_blank_values=True))
        if parts.keys() & {"from", "to", "weights"}:
            return replace(self, intervention=Intervention.parse(text))
        if "only" in parts:
            if len(parts) > 1 or not parts["only"]:
                raise BadInput(f"comparison run {text!r}: only= names one modality, without other parts")
            return replace(self, only=parts["only"])
        for key in parts:
            check_name("part of the comparison run", key, ("filter", "faults", "only", "from", "to", "weights"))
        faults = Faults.parse(parts["faults"]) if "faults" in parts else self.faults
        other = replace(self, filter=parts.get("filter", self.filter), faults=faults)
        if other == self:
            raise BadInput(f"{text!r} describes the selected run, not another run to compare with")
        return other
