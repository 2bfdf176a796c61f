"""JSON from outside: what can be sent on is read as it stands, all else is refused in one line."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from pydantic import TypeAdapter

from beliefscope.app.workspace.json_files import read_record
from beliefscope.datasets.io.strict_json import read_json

REFUSED = {
    "NaN": "NaN is no number",
    '{"a": [-Infinity]}': "-Infinity is no number",
    "1e999": "not JSON compliant",
    "1" + "0" * 400: "401 digits",
    '{"a": ' + "-1" + "0" * 400 + "}": "402 digits",
    "9" * 5000: "digits",
    '"\\ud800"': "half a character",
    '{"\\ud800": 1}': "half a character",
    "[" * 200_000: "nested too deeply",
    "": "Expecting value",
}


@pytest.mark.parametrize("text", REFUSED, ids=lambda text: text[:12])
def test_what_nobody_could_send_on_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(ValueError, match=REFUSED[text]) as caught:
        read_json(text)
    assert "\n" not in str(caught.value)
    json.dumps(str(caught.value), ensure_ascii=False).encode()


@pytest.mark.parametrize("value", [0, -1, 2**64, 10**308, -0.5, 1e-320, "é☃", [{}], {"": None}])
def test_all_else_is_read_as_it_stands(value: object) -> None:
    assert read_json(json.dumps(value)) == value


def test_a_whole_number_never_becomes_infinity(tmp_path: Path) -> None:
    """As pydantic, which checks the workspace's files, would have it."""
    path = tmp_path / "job.json"
    path.write_text("1" + "0" * 400)
    with pytest.raises(ValueError, match="401 digits"):
        read_record(TypeAdapter(float), path)
