"""First maps of logs whose names are not English."""

from __future__ import annotations

import tomllib

import numpy as np

from beliefscope.recordings.log_readers.guess import guess_map
from beliefscope.recordings.log_readers.messages import Preview


def test_a_guessed_map_keeps_letters_dates_and_texts() -> None:
    t = np.arange(20.0)
    columns = {
        "Zeit": np.datetime64("2026-01-01T00:00") + t.astype("timedelta64[s]"),
        "timestamp": t,
        "Fahrt": np.array(["A"] * 20),
        "Kurs ψ": t,
        "Kompass °": t,
        "ekf.mean": np.stack([t, t], 1),
        "ekf.std": np.stack([t, t], 1),
    }
    text = guess_map(Preview(columns), "log")
    values = tomllib.loads(text)
    assert values["time"] == "timestamp"
    assert values["estimate"] == {"mean": "ekf.mean", "std": "ekf.std"}
    assert values["sensors"] == {"Kurs_ψ": "Kurs ψ", "Kompass": "Kompass °"}
    assert '# not numbers, for time, episode or [covariates]: ["Zeit", "Fahrt"]' in text
    del columns["timestamp"]
    assert tomllib.loads(guess_map(Preview(columns), "log"))["time"] == "Zeit"
