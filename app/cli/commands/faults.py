"""``beliefscope faults``"""

from __future__ import annotations

from beliefscope.app.cli import output
from beliefscope.app.cli.options import Json, check


def faults(json: Json = None) -> None:
    """List the faults that --faults knows.

    A faults is one fault or several, divided by commas, that act in their order. A value right behind a fault's name
    is its first parameter's; others follow as :parameter=value. Every fault acts from step 0 to the end, unless
    :from=STEP and :to=STEP say otherwise. Values are SI, gray levels from 0 to 255, and pixels.

    \b
    Examples:
      beliefscope faults --json -
      beliefscope evaluate door --filter crossmodal-pf --faults blackout=0.4,force_bias:x=5:from=20:to=60
    """
    from beliefscope.datasets.faults.injection import FAULT_PRESETS, described

    check(None, json)
    catalog = described()
    lines = []
    for fault in catalog:
        lines.append(f"{fault['fault']:<18}{fault['meaning']}")
        for one in fault["parameters"][:-2]:
            written = one["name"] if one["default"] is None else f"{one['name']}={one['default']}".removesuffix(".0")
            lines.append(f"  {written:<16}{one['unit']}: {one['meaning']}")
    lines += ["", "To try first:", *(f"  {text:<30}{name}" for name, text in FAULT_PRESETS.items())]
    output.result({"faults": catalog, "presets": FAULT_PRESETS}, "\n".join(lines), json)
