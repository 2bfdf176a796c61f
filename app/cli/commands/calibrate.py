from pathlib import Path

from beliefscope.app.cli import console, options as opt


def calibrate(
    runs: opt.Runs,
    output: Path = opt.output_file("CALIBRATION", "Output .json file.", ".json", default=...),
    level: float = opt.option("P", "Share of the steps that a region must contain.", 0.95),
) -> console.Result:
    """Calibrate the uncertainty of a filter.

    Fits factors on the covariances, and conformal regions, to every other held-out episode, and reports the coverage
    over the rest, before and after. Conformal regions reach their level for any filter, with or without a covariance.
    beliefscope.filters.calibration applies the file in your own loop. Details: docs/calibration.md.

    \b
    Examples:
      beliefscope calibrate door --filter crossmodal-ekf -o calibration.json
      beliefscope calibrate door --filter lstm.safetensors --data door.h5 --level 0.9 -o calibration.json
      beliefscope calibrate push --filter my_filter.py:build -o calibration.json --json -
    """
    from beliefscope.filters.calibration import save_calibration
    from beliefscope.inspect.calibrate import calibrate as fit, check_level
    from beliefscope.inspect.traces.batch import trace_all

    checkpoint, faults = runs.open()
    with runs.episodes(checkpoint.task) as data, console.progress("Filtering") as advance:
        held_out = data.held_out()
        fitted, tested = held_out[::2], held_out[1::2]
        check_level(level, len(fitted), len(tested))
        settings = runs.settings(faults)
        traces = trace_all(checkpoint, data, [*fitted, *tested], **settings, progress=advance)
        by_index = {trace.episode_index: trace for trace in traces}
        data_hash = data.hash
    report = fit([by_index[i] for i in fitted], [by_index[i] for i in tested], level, data_hash)
    save_calibration(report.calibration, output)
    return console.Result(report.to_dict(), report.text, output)
