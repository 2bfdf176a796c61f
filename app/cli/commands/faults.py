from beliefscope.app.cli import console


def faults() -> console.Result:
    """List the sensor faults available for --faults.

    Several faults are separated by commas and applied in order. The value after a fault's name is its first
    parameter; others follow as :parameter=value. By default, a fault covers all steps; :from=STEP is its first step,
    :to=STEP the first step after it. Values are in SI units, gray levels from 0 to 255, and pixels.

    \b
    Examples:
      beliefscope faults --json -
      beliefscope evaluate door --filter crossmodal-pf --faults blackout=0.4,force_bias:x=5:from=20:to=60
    """
    from beliefscope.datasets.faults.injection import FAULT_PRESETS, fault_catalog

    catalog = fault_catalog()
    lines = []
    for fault in catalog:
        lines.append(f"{fault.fault:<20}{fault.meaning}")
        for parameter in fault.parameters[:-2]:
            usage = parameter.name + ("" if parameter.default is None else f"={parameter.default}".removesuffix(".0"))
            lines.append(f"  {usage:<18}{parameter.unit}: {parameter.meaning}")
    lines += ["", "Presets:", *(f"  {text:<30}{name}" for name, text in FAULT_PRESETS.items())]
    return console.Result({"faults": catalog, "presets": FAULT_PRESETS}, "\n".join(lines))
