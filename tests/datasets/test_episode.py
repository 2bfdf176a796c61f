"""Episodes."""

from __future__ import annotations

import numpy as np

import beliefscope as bs


def test_contact_is_by_default_that_of_the_covariates() -> None:
    task = bs.Task(
        "press", (bs.Component("x", "m"),), {"force": (1,)}, {"haptics": ("force",)}, 0, 0.1,
        covariates={"contact": bs.Covariate("boolean")},
    )  # fmt: skip
    values = {"observations": {"force": np.zeros((3, 1))}, "covariates": {"contact": np.array([0.0, 1.0, np.nan])}}
    assert bs.Episode(task, np.zeros((3, 1)), **values).contact.tolist() == [False, True, False]
    own = bs.Episode(task, np.zeros((3, 1)), contact=np.ones(3, bool), **values)
    assert own.contact.tolist() == [True] * 3
