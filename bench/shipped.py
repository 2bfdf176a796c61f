"""Writes filters/pretrained/README.md from the weights that lie there: how each was made, and what it does.

python bench/shipped.py > filters/pretrained/README.md
"""

from __future__ import annotations

from pathlib import Path

from beliefscope.datasets.catalog import TASKS
from beliefscope.datasets.faults.injection import Faults
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.filters.checkpoint import PRETRAINED, Checkpoint, load_checkpoint
from beliefscope.filters.evaluate import evaluate
from beliefscope.filters.training.stages import BLACKOUTS

COLLECTED = {
    "door": "beliefscope collect door --episodes 600 --steps 100 --seed 1 -o door.h5",
    "push-real": "beliefscope convert push-real --data mit_push -o push-real.h5",
    "push": "beliefscope collect push --episodes 500 --steps 100 --seed 1 -o push.h5",
}
START = """\
Written by `python bench/shipped.py`. The record inside each file (safetensors header, key `beliefscope`) holds command,
plan, seed, data hash, versions, seconds and all metrics. The belief starts at the truth with covariance 0.1 I
(standardised); the first 30 steps do not count. `fused` is the filter as it is; a modality's name is the same filter
with beta one-hot on it. Position: root mean square distance. Simulated data have this hash on one kind of CPU; on
another the last bits of a contact may come out otherwise.
"""


def rows(name: str, metrics: dict[str, dict[str, dict]]) -> list[str]:
    lines = []
    for blackout, by_model in metrics.items():
        for model, m in by_model.items():
            numbers = [f"{m['rmse']['position_cm']:.2f}"]
            numbers += [f"{value:.2f}" for key, value in m["rmse"].items() if key.endswith("_deg")]
            consistent = ["-", "-"] if m["nees"] is None else [f"{m['nees']:.2f}", f"{m['coverage95']:.0%}"]
            lines.append(f"| {name} | {float(blackout):.0%} | {model} | {' | '.join(numbers + consistent)} |")
    return lines


def head(task: str) -> list[str]:
    angles = [f" {c.name}, deg |" for c in TASKS[task].components if c.unit == "rad"]
    line = (
        "| filter | black pictures | decides | position, cm |" + "".join(angles) + " NEES / n | in the 95 % ellipsoid |"
    )
    return [line, "| --- " * (line.count("|") - 1) + "|"]


def on_the_sample(checkpoint: Checkpoint) -> dict[str, dict[str, dict]]:
    with open_dataset(sample_path(checkpoint.task.name)) as data:
        test = [data[s.index] for s in data.summaries if s.split == "test"]
    models = [None, *(checkpoint.filter.names if checkpoint.filter.architecture.fusion == "crossmodal" else ())]
    return {
        f"{share:g}": {
            only or "fused": evaluate(
                checkpoint.filter, test, faults=Faults.parse(f"blackout={share}"), only=only
            ).to_dict()
            for only in models
        }
        for share in BLACKOUTS
    }


def section(task: str, paths: list[Path]) -> list[str]:
    checkpoints = [load_checkpoint(path) for path in paths]
    first = checkpoints[0].record
    count = first["episodes"]
    lines = [f"## {task}", ""]
    measured = count["test"] or count["val"]
    shared = "" if count["test"] else ", which also chose the best weights of every stage"
    lines += [f"Trained on {count['train']} episodes, measured on {measured} others{shared}:", "", "```sh"]
    lines += [COLLECTED[task]] if task in COLLECTED else []
    lines += [f"{c.record['command']} -o {p.name}" for c, p in zip(checkpoints, paths, strict=True)]
    lines += ["```", "", f"Data hash of the file: `{first['data_hash']}`."]
    lines += ["", "| file | SHA-256 | seconds of training | device |", "| --- | --- | --- | --- |"]
    for c, p in zip(checkpoints, paths, strict=True):
        lines.append(f"| `{p.name}` | `{c.hash}` | {c.record['seconds']:.0f} | {c.record['device']} |")
    lines += ["", f"On these {measured} episodes, at the end of training:", ""]
    lines += head(task)
    for c in checkpoints:
        lines += rows(c.name, c.record["metrics"])
    try:
        sample_path(task)
    except ValueError:
        return [*lines, ""]
    lines += ["", "On the test episodes of the sample set that ships, none of which is in that file "]
    lines[-1] += f"(`beliefscope evaluate {task} --filter NAME --faults blackout=B --only MODALITY`):"
    lines += ["", *head(task)]
    for c in checkpoints:
        lines += rows(c.name, on_the_sample(c))
    return [*lines, ""]


def main() -> None:
    print("# Trained weights\n")
    print(START)
    for task in TASKS:
        paths = sorted(PRETRAINED.glob(f"{task}-*.safetensors"))
        # ``push-*`` also finds ``push-real-*``.
        paths = [path for path in paths if load_checkpoint(path).task.name == task]
        if paths:
            print("\n".join(section(task, paths)))


if __name__ == "__main__":
    main()
