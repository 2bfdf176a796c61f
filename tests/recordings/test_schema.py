"""The schema is complete and matches the documentation."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import beliefscope
from beliefscope.datasets.episode import Episode
from beliefscope.inspect.palette import COLOURS, SPARE_COLOURS, colour
from beliefscope.inspect.trace import ARRAYS
from beliefscope.recordings.schema import FORMAT_VERSION, PROPERTIES, SCHEMA

DOCS = (Path(beliefscope.__file__).resolve().parents[2] / "docs" / "recordings.md").read_text()


def test_every_array_of_a_trace_has_a_path() -> None:
    stored = {entity.path.removeprefix("trace/") for entity in SCHEMA if entity.archetype == "Trace"}
    episode_arrays = {
        field.name for field in fields(Episode) if "Array" in str(field.type) and "Mapping" not in str(field.type)
    }
    assert stored == set(ARRAYS) | episode_arrays


def test_paths_are_documented() -> None:
    rows = {f"| `{e.path}` | {e.archetype} | {e.shape} | {e.unit} | {e.needs} | {e.meaning} |" for e in SCHEMA}
    rows |= {f"| `{name}` | {meaning} |" for name, meaning in PROPERTIES.items()}
    tables = {line for line in DOCS.split("## Paths")[1].splitlines() if line.startswith("| ") and "---" not in line}
    headings = {
        "| path | archetype | shape | unit | exists for | meaning |",
        "| property | meaning |",
    }
    assert tables - headings == rows
    assert f"This is format {FORMAT_VERSION}." in DOCS


def test_paths_are_unique() -> None:
    paths = [entity.path for entity in SCHEMA]
    assert len(set(paths)) == len(paths)


def test_every_modality_has_its_colour() -> None:
    modalities = ("image", "sound", "touch")
    assert colour("image", modalities) == COLOURS["image"]
    assert [colour(name, modalities) for name in ("sound", "touch")] == list(SPARE_COLOURS[:2])
    without_image = ("haptics", "camera", "sound")
    assert [colour(name, without_image) for name in without_image[1:]] == [COLOURS["image"], SPARE_COLOURS[0]]
