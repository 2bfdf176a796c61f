"""Messages of the page over the socket of a view."""

from __future__ import annotations

from typing import Any

import pytest

from beliefscope.app.protocol.messages import MoveViewpoint, SceneLayers, Theme, parse_view_message
from beliefscope.datasets.errors import BadInput


def test_scene_layers() -> None:
    assert parse_view_message({"type": "scene_layers"}) == SceneLayers()
    values = {"hidden": ["force", "map"], "ground": "haptics", "height": "belief", "tint": "share", "scale": "log"}
    expected = SceneLayers(**values | {"hidden": frozenset(values["hidden"])})  # type: ignore[arg-type]
    assert parse_view_message({"type": "scene_layers", **values, "unknown": 1}) == expected


def test_other_messages() -> None:
    assert parse_view_message({"type": "viewpoint", "at": "above"}) == MoveViewpoint(at="above")
    assert parse_view_message({"type": "theme", "dark": True}) == Theme(dark=True)


@pytest.mark.parametrize(
    ("message", "error"),
    [
        ({"type": "scene_layers", "hidden": "map"}, "scene_layers.hidden: Input should be a valid frozenset."),
        ({"type": "scene_layers", "hidden": ["floor"]}, "scene_layers.hidden.0: Input should be 'replay', 'objects'"),
        ({"type": "scene_layers", "tint": "modality"}, "scene_layers.tint: Input should be 'weight' or 'share'."),
        ({"type": "scene_layers", "ground": 3}, "scene_layers.ground: Input should be a valid string."),
        ({"type": "viewpoint", "at": "moon"}, "viewpoint.at: Input should be 'first', 'above' or 'camera'."),
        ({"type": ["theme"]}, "message type .* does not exist. Available: cursor, scene_layers, theme, viewpoint."),
    ],
)
def test_invalid_messages(message: dict[str, Any], error: str) -> None:
    with pytest.raises(BadInput, match=error):
        parse_view_message(message)
