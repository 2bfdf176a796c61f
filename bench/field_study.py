"""Compare all fusion rules on a field task at several shares of image outages, claim by claim.

    python bench/field_study.py DIR --seeds 3 -o docs/study/push-field

DIR has train.h5 and no_outages.h5 of ``bench/field_tasks.py``, whose plan trains every filter; existing checkpoints and
results (DIR/study) are not computed again. Outages of 2 s are injected into the test episodes, which have none. Where
there is only outages.h5, as of real pushes, they are added to its own ones. Errors are RMSE from step 0: squared errors
are averaged over the seeds; brackets are 95 % intervals over trajectories.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Sequence
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from field_tasks import trained
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.faults.injection import NO_FAULTS, Faults
from beliefscope.datasets.store import open_dataset
from beliefscope.filters.evaluate import evaluate
from beliefscope.inspect.statistics.intervals import jackknife

Array = NDArray[np.float64]

OUTAGES = (0.0, 0.4, 0.8, 0.95)
"""Shares of steps whose image is removed."""

RULES = ("crossmodal", "unimodal", "feature")
INFORMATION = "information-ekf"
SINGLE = (f"{INFORMATION}:image", f"{INFORMATION}:haptics")
FILTERS = (
    INFORMATION,
    *SINGLE,
    *(f"{rule}-{kind}" for kind in ("ekf", "pf") for rule in (*RULES, "image", "haptics")),
    "lstm",
    "transformer",
)

CLAIMS: tuple[tuple[str, str, tuple[str, ...]], ...] = (
    *(
        (
            f"{rule} fusion is better than the better modality, {kind.upper()}",
            f"{rule}-{kind}",
            (f"image-{kind}", f"haptics-{kind}"),
        )
        for kind in ("ekf", "pf")
        for rule in RULES
    ),
    ("calibrated fusion is better than its better modality", INFORMATION, SINGLE),
    *(
        (f"crossmodal is better than {other} fusion, {kind.upper()}", f"crossmodal-{kind}", (f"{other}-{kind}",))
        for kind in ("ekf", "pf")
        for other in RULES[1:]
    ),
    *(
        (f"the crossmodal {kind.upper()} is better than the LSTM", f"crossmodal-{kind}", ("lstm",))
        for kind in ("ekf", "pf")
    ),
    (
        "calibrated fusion is better than the best rule of the paper",
        INFORMATION,
        tuple(f"{r}-{k}" for k in ("ekf", "pf") for r in RULES),
    ),
    ("calibrated fusion is better than LSTM and transformer", INFORMATION, ("lstm", "transformer")),
)
"""Text, filter, and the filters of which it must be better than the best."""

HEAD = """# Fusion rules on {task}

RMSE from step 0 on {count} test episodes of {seconds:.0f} s. Columns are the share of the steps without an image, in
outages. Training seeds: {seeds}; brackets are 95 % intervals over episodes. A claim holds if the interval of the
ratio of errors is below 1, does not hold if it is above 1, and is open otherwise. *Calibrated fusion* is
`information-ekf`. Summary: [field tasks](../field_tasks.md#fusion-rules-and-outages).
"""


def label(name: str, seed: int) -> str:
    return f"{name}#{seed}" if seed else name


def test_episodes(folder: Path) -> list[Episode]:
    paths = (folder / "no_outages.h5", folder / "outages.h5")
    with open_dataset(next(path for path in paths if path.exists())) as data:
        return list(data)


def black_shares(episodes: Sequence[Episode]) -> list[int]:
    """Share of steps without an image at each of ``OUTAGES``, in percent."""
    own = float(np.mean([episode.observations["image"].max(axis=(1, 2)) == 0 for episode in episodes]))
    return [round(100 * (own + (1 - own) * share)) for share in OUTAGES]


def results(folder: Path, name: str, seed: int) -> dict[str, Array]:
    """Error key -> (outages, trajectories) mean squared errors of a filter."""
    path = folder / "study" / f"{label(name, seed).replace(':', '-').replace('#', '-seed')}.json"
    if not path.exists():
        filter_, document = trained(folder, label(name, seed)), {}
        episodes = test_episodes(folder)
        for share in OUTAGES:
            faults = Faults.parse(f"image_outage={share}:seconds=2") if share else NO_FAULTS
            metrics = evaluate(filter_, episodes, faults=faults)
            for i, key in enumerate(metrics.rmse, 1):
                document.setdefault(key, []).append((metrics.squares[:, i] / metrics.squares[:, 0]).tolist())
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps(document))
    return {key: np.array(values) for key, values in json.loads(path.read_text()).items()}


def rmse(squares: Array) -> tuple[float, float, float]:
    """Value and interval of the RMSE of mean squared errors (R,)."""
    sums = np.stack([np.ones_like(squares), squares], 1)
    value, low, high = jackknife(sums, lambda s: np.sqrt(s[..., 1] / s[..., 0]))
    return float(value), float(low), float(high)


def ratio(squares: Array, others: Sequence[Array]) -> tuple[float, float, float]:
    """Error of a filter over that of the best other one."""
    value, low, high = jackknife(np.stack([squares, *others], 1), lambda s: np.sqrt(s[..., 0] / s[..., 1:].min(-1)))
    return float(value), float(low), float(high)


def verdict(low: float, high: float) -> str:
    return "holds" if high < 1.0 else "**does not**" if low > 1.0 else "open"


def tables(values: dict[str, dict[str, Array]], key: str, shares: Sequence[int]) -> str:
    """Errors of all filters, and the claims, by share of outages."""
    head = " | ".join(f"{share} %" for share in shares)
    lines = [f"| filter | {head} |", f"| --- |{' ---: |' * len(OUTAGES)}"]
    for name, by_key in values.items():
        cells = [f"{v:.2f} [{low:.2f}, {high:.2f}]" for v, low, high in map(rmse, by_key[key])]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    lines += ["", f"| claim | {head} |", f"| --- |{' --- |' * len(OUTAGES)}"]
    for text, name, others in CLAIMS:
        if all(other in values for other in (name, *others)):
            rows = [ratio(values[name][key][i], [values[o][key][i] for o in others]) for i in range(len(OUTAGES))]
            cells = [f"{verdict(low, high)}: {v:.2f} [{low:.2f}, {high:.2f}]" for v, low, high in rows]
            lines.append(f"| {text} | {' | '.join(cells)} |")
    return "\n".join(lines)


def draw(values: dict[str, dict[str, Array]], key: str, shares: Sequence[int], path: Path) -> None:
    """RMSE against the share of outages, one line per filter."""
    figure, axes = plt.subplots(figsize=(7.2, 4.2), layout="constrained")
    colours = dict(zip((*RULES, "image", "haptics", "lstm", "transformer"), plt.get_cmap("tab10").colors, strict=False))
    for name, by_key in values.items():
        rule = name.partition(":")[2] or name.partition("-")[0]
        style = {"color": colours.get(rule, "black"), "linestyle": "--" if name.endswith("-pf") else "-"}
        if INFORMATION in name:
            style |= {"linewidth": 2.5}
        axes.plot(
            shares,
            [rmse(s)[0] for s in by_key[key]],
            marker="o",
            markersize=3,
            label=name,
            **style,
        )
    axes.set(xlabel="steps without an image (%)", ylabel=f"RMSE, {key.replace('_', ' in ')}", ylim=(0, None))
    axes.legend(fontsize=7, ncols=2, frameon=False, handlelength=3.5)
    figure.savefig(path, metadata={"Date": None})
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--filter", action="append", choices=FILTERS, help="repeatable; default: all")
    parser.add_argument("-o", "--output", type=Path, required=True, help="path without suffix of the table and figures")
    options = parser.parse_args()
    torch.set_num_threads(1)
    values: dict[str, dict[str, Array]] = {}
    for name in options.filter or FILTERS:
        seeds = [results(options.folder, name, seed) for seed in range(options.seeds)]
        values[name] = {key: np.mean([seed[key] for seed in seeds], axis=0) for key in seeds[0]}
    keys = [key for key in values[INFORMATION] if key in ("position_cm", "angle_deg")]
    figures = {key: options.output.with_name(f"{options.output.name}-{key.partition('_')[0]}.svg") for key in keys}
    episodes = test_episodes(options.folder)
    seconds, shares = float(np.mean([episode.times[-1] for episode in episodes])), black_shares(episodes)
    sections = [HEAD.format(task=options.output.name, count=len(episodes), seconds=seconds, seeds=options.seeds)]
    for key, path in figures.items():
        title = key.replace("_", ", ")
        sections.append(f"## {title}\n\n![{title}]({path.name})\n\n{tables(values, key, shares)}\n")
        draw(values, key, shares, path)
    options.output.with_suffix(".md").write_text("\n".join(sections))
    print("\n".join(sections))


if __name__ == "__main__":
    main()
