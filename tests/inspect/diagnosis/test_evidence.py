"""Evidence of a diagnosis names the sensor that it is about."""

from __future__ import annotations

import numpy as np
from tests.inspect.diagnosis.test_diagnose import checkpoint

from beliefscope.inspect.diagnosis.case import compared
from beliefscope.inspect.diagnosis.conclusion import sensor_about
from beliefscope.inspect.diagnosis.undo.run_inputs import RunInputs
from beliefscope.inspect.diagnostics.healthy_profile import HealthyProfile


def test_evidence_names_its_sensor() -> None:
    names = {
        "level/force x/free motion": "force",
        "level/haptics force x/free motion": "force",
        "noise/effector_position z/all": "effector_position",
        "offset/control 3/all": "control",
        "nees/fused/all": "",
        "delay/labels/all": "",
    }
    rows = [dict.fromkeys(names, 1.0)]
    record = HealthyProfile("test", 20, None, {name: 1.0 + 0.1 * np.arange(20) for name in names})
    of_sensors = [{name: 1.0 for name in names if not name.startswith("nees")}]
    case = compared(RunInputs(checkpoint(), {}, 300, frozenset()), [], rows, of_sensors, record, 0.05)
    assert {name: sensor_about(case, name) for name in names} == names
