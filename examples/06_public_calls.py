"""A call of every function of the public interface, on small settings.

python examples/06_public_calls.py FOLDER
"""

import sys
from pathlib import Path

import numpy as np

import beliefscope as bs


def main(folder: Path) -> None:
    checkpoint: bs.Checkpoint = bs.load_filter("push/crossmodal-ekf")
    data: bs.Dataset = bs.open_dataset("push")
    episode: bs.Episode = data[9]
    print(checkpoint.name, len(data), episode.states.shape)

    run: bs.Trace = bs.trace(checkpoint, data, 9, faults="blackout:from=30:to=50", seed=0)
    bs.save_trace(run, folder / "run.trace")
    print(bs.load_trace(folder / "run.trace"))

    maps: list[bs.LikelihoodMap] = bs.maps(checkpoint, run, [20, 40], size=21, quantity="posterior")
    print(maps[1].layers, maps[1].peaks())
    for name, diagnostic in bs.inspect_run(run, checkpoint).items():
        print(name, diagnostic.verdict)
        diagnostic.plot().savefig(folder / f"{name}.svg")

    diagnosis: bs.Diagnosis = bs.diagnose(checkpoint, data, [9, 19], faults="image_frozen:from=40")
    print(diagnosis.headline)
    healthy: bs.HealthyProfile = bs.healthy_record(checkpoint, data)  # the checkpoint has one; other filters need it
    print(bs.diagnose(checkpoint, data, [9, 19], faults="blackout=0.8", profile_from=healthy).headline)
    few, many = ([bs.trace(checkpoint, data, index) for index in data.held_out()[a:b]] for a, b in ((0, 2), (2, 13)))
    print(bs.diagnose_runs(few, many).headline)
    metrics: bs.Metrics = bs.evaluate(checkpoint, data, [9, 19], faults="blackout=0.4", start_offset="3cm")
    print(metrics.rmse, metrics.nees, metrics.baselines["stay"])
    failures: bs.Failures = bs.find_failures(checkpoint, data, [9, 19], by="disagreement")
    print(failures.verdict, [event.step for event in failures.worst(3)])

    small = bs.open_dataset([data[i] for i in range(20)])
    tuned = bs.finetune(checkpoint, small, folder / "tuned.safetensors", train=["weights-only"], steps=2, check=2)
    comparison: bs.CheckpointComparison = bs.compare(checkpoint, tuned, data, [9, 19])
    print(comparison.verdict)

    episodes = [data[9], data[19]]
    path: Path = bs.save_dataset(episodes, folder / "two.h5")
    table: bs.Experiments = bs.sweep(folder / "sweep", [folder / "tuned.safetensors"], [path], faults=["", "blackout"])
    print(table.overview().to_pylist()[0]["error"], bs.experiments(folder / "sweep").phases())

    print(bs.record(run, folder / "run.rrd", checkpoint, map_stride=50))
    print(bs.export_page(run, folder / "run.html", checkpoint))

    widget = bs.show(run, checkpoint)
    widget.step = 40

    own = bs.load_filter(follow_hand, task="push", name="hand")
    print(bs.trace(own, bs.open_dataset(episodes), 0))
    attitude = bs.Task("attitude", bs.rotation("attitude"), {"compass": (3,)}, {"compass": ("compass",)}, 0, 0.02)
    print(attitude.main_error.label)


def follow_hand(*, observations: dict[str, np.ndarray], controls: np.ndarray) -> np.ndarray:
    """A filter of whole sequences: the puck is where the hand is, (T, N, 2)."""
    return observations["effector_position"][..., :2]


def serve(folder: Path) -> None:
    """Runs until interrupted."""
    bs.serve([folder / "tuned.safetensors"], [folder / "two.h5"], workspace=folder / "workspace", port=0)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
