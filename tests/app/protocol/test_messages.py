"""Validation of the page's messages."""

from __future__ import annotations

from typing import Any

import pytest

from beliefscope.app.protocol.messages import MoveViewpoint, SceneLayers, parse_view_message
from beliefscope.datasets.errors import BadInput


def test_messages_are_parsed() -> None:
    assert parse_view_message({"type": "scene_layers"}) == SceneLayers()
    values = {"hidden": ["force", "map"], "ground": "haptics", "height": "belief", "tint": "share", "scale": "log"}
    message = parse_view_message({"type": "scene_layers", **values, "unknown": 1})
    assert message == SceneLayers(**values)  # type: ignore[arg-type]
    assert parse_view_message({"type": "viewpoint", "at": "above"}) == MoveViewpoint(at="above")


@pytest.mark.parametrize(
    ("message", "field"),
    [
        ({"type": "scene_layers", "hidden": "map"}, "scene_layers.hidden"),
        ({"type": "scene_layers", "hidden": ["floor"]}, "scene_layers.hidden"),
        ({"type": "scene_layers", "hidden": [["map"]]}, "scene_layers.hidden"),
        ({"type": "scene_layers", "tint": "modality"}, "scene_layers.tint"),
        ({"type": "scene_layers", "ground": 3}, "scene_layers.ground"),
        ({"type": "viewpoint", "at": "moon"}, "viewpoint.at"),
    ],
)
def test_invalid_messages_are_rejected(message: dict[str, Any], field: str) -> None:
    with pytest.raises(BadInput, match=field):
        parse_view_message(message)
