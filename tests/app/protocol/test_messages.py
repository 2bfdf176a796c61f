"""Messages of the page over the socket of a view."""

from __future__ import annotations

import re
from typing import Any

import pytest
from pydantic import ValidationError

from beliefscope.app.protocol.messages import VIEW_MESSAGE, MoveViewpoint, SceneLayers, Theme, describe_error


def test_scene_layers() -> None:
    assert VIEW_MESSAGE.validate_python({"type": "scene_layers"}) == SceneLayers()
    values = {"hidden": ["force", "map"], "ground": "haptics", "height": "belief", "tint": "share", "scale": "log"}
    expected = SceneLayers(**values | {"hidden": frozenset(values["hidden"])})  # type: ignore[arg-type]
    assert VIEW_MESSAGE.validate_python({"type": "scene_layers", **values, "unknown": 1}) == expected


def test_other_messages() -> None:
    assert VIEW_MESSAGE.validate_python({"type": "viewpoint", "at": "above"}) == MoveViewpoint(at="above")
    assert VIEW_MESSAGE.validate_python({"type": "theme", "dark": True}) == Theme(dark=True)


@pytest.mark.parametrize(
    ("message", "error"),
    [
        ({"type": "scene_layers", "hidden": "map"}, "scene_layers.hidden: Input should be a valid frozenset."),
        ({"type": "scene_layers", "hidden": ["floor"]}, "scene_layers.hidden.0: Input should be 'replay', 'objects'"),
        ({"type": "scene_layers", "tint": "modality"}, "scene_layers.tint: Input should be 'weight' or 'share'."),
        ({"type": "scene_layers", "ground": 3}, "scene_layers.ground: Input should be a valid string."),
        ({"type": "viewpoint", "at": "moon"}, "viewpoint.at: Input should be 'first', 'above' or 'camera'."),
        ({"type": ["theme"]}, "Input tag .* does not match any of the expected tags: 'cursor', 'scene_layers'"),
    ],
)
def test_invalid_messages(message: dict[str, Any], error: str) -> None:
    with pytest.raises(ValidationError) as caught:
        VIEW_MESSAGE.validate_python(message)
    assert re.search(error, f"{describe_error(caught.value)}.")
