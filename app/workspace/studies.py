"""Folders of studies: tables in ``study.json`` and the trained checkpoints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import AliasChoices, BaseModel, Field, FiniteFloat, ValidationError

from beliefscope.app.protocol.messages import describe_error
from beliefscope.app.workspace.json_files import content
from beliefscope.datasets.errors import BadInput

SHIPPED = "shipped"
"""Name of the built-in study. The weights of its first seed are built in, too."""

FILE = "study.json"
FINISHED = "finished"

Numbers = Mapping[str, FiniteFloat | None]
CellName = Annotated[str, Field(pattern=r"^[\w.+-]+/[\w.+-]+/seed\d+$")]
"""TASK/FILTER/seedK."""


class Row(BaseModel):
    """A row of the table (``filters.training.study_table.Row``). Aliases are field names of earlier versions."""

    task: str
    filter: str
    blackout: FiniteFloat | None
    seeds: int
    requested: Annotated[int, Field(validation_alias=AliasChoices("requested", "asked"))]
    failed: int
    mean: Numbers
    spread: Numbers
    bounds: tuple[FiniteFloat, FiniteFloat] | None = None
    by_seed: Annotated[Mapping[str, Numbers], Field(validation_alias=AliasChoices("by_seed", "each"))] = {}


class Results(BaseModel):
    """Content of ``study.json``.

    Attributes:
        checkpoints: trained cell -> hash; missing in files of earlier versions. cells: cell -> state.
    """

    preset: str
    tasks: Mapping[str, Mapping[str, str]]
    seeds: Annotated[int, Field(ge=1)]
    rows: list[Row]
    checkpoints: Mapping[str, str] = {}
    cells: Mapping[CellName, str] = {}

    @property
    def unfinished(self) -> list[str]:
        """Names of the unfinished cells."""
        return [name for name, state in self.cells.items() if state != FINISHED]


@dataclass(frozen=True)
class Study:
    """The folder of a study. name: on the page. has_checkpoints: whether ``cells/`` contains the checkpoints."""

    name: str
    folder: Path
    has_checkpoints: bool

    def read(self) -> Results:
        """The current results. Raises BadInput if there are none or they are invalid."""
        path = self.folder / FILE
        try:
            return Results.model_validate_json(content(path))
        except OSError:
            raise BadInput(f"{str(self.folder)!r} is not a study: it has no {FILE}") from None
        except ValidationError as error:
            raise BadInput(f"{str(path)!r} does not contain the results of a study: {describe_error(error)}") from None

    def checkpoint(self, cell: str) -> Path:
        """Path of a cell's checkpoint."""
        return self.folder / "cells" / f"{cell}.safetensors"
