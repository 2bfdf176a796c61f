"""Coverage of nominal 95 % intervals over few trajectories with skewed spread between them.

python bench/coverage.py    # the tables of docs/diagnostics.md, in Markdown

The last lines are the measured spread of log NEES/n between trajectories, from the healthy profiles.

Every cell simulates 4000 data sets. ``mean``: of positive trajectory values, such as NEES/n, with the distribution of
the row. ``change``: logarithm of the ratio of two RMSEs of the same trajectories, whose squared errors correlate by 0.5
on the log scale. ``correlation``: of two variables over the steps of trajectories with different levels.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

from beliefscope.inspect.statistics.intervals import correlate, correlation_sums, jackknife, mean_interval

SIZES = (5, 8, 14, 50)
REPEATS, SEED = 4000, 0
PROFILES = Path(__file__).parents[1] / "filters" / "pretrained"
ROWS: dict[str, tuple[str, float]] = {
    "log-normal, sigma 0.3": ("lognormal", 0.3),
    "log-normal, sigma 0.5": ("lognormal", 0.5),
    "log-normal, sigma 0.8": ("lognormal", 0.8),
    "log-normal, sigma 1.0": ("lognormal", 1.0),
    "log-normal, sigma 1.2": ("lognormal", 1.2),
    "log-normal, sigma 1.5": ("lognormal", 1.5),
    "gamma, CV 0.5": ("gamma", 0.5),
    "gamma, CV 1.0": ("gamma", 1.0),
    "Lomax, alpha 3": ("lomax", 3.0),
}
"""Title -> distribution of mean 1, and its parameter."""


def draw(kind: str, parameter: float, size: tuple[int, ...], rng: np.random.Generator) -> np.ndarray:
    """Values of mean 1."""
    if kind == "lognormal":
        return np.exp(parameter * rng.normal(size=size) - parameter**2 / 2.0)
    if kind == "gamma":
        shape = 1.0 / parameter**2
        return rng.gamma(shape, 1.0 / shape, size)
    return rng.pareto(parameter, size) * (parameter - 1.0)


def covers(interval: tuple[np.ndarray, np.ndarray, np.ndarray], truth: float) -> float:
    """Share of intervals that contain the truth."""
    _, low, high = interval
    return float(((low <= truth) & (truth <= high)).mean())


def mean_coverage(kind: str, parameter: float, size: int, repeats: int = REPEATS, seed: int = SEED) -> float:
    """Coverage of ``mean_interval`` for trajectories of 60 to 120 steps."""
    rng = np.random.default_rng(seed)
    counts = rng.integers(60, 121, (size, repeats))
    return covers(mean_interval(draw(kind, parameter, (size, repeats), rng) * counts, counts), 1.0)


def percentile_coverage(kind: str, parameter: float, size: int, repeats: int = 1000, seed: int = SEED) -> float:
    """Coverage of the percentile bootstrap of the mean, for comparison."""
    rng = np.random.default_rng(seed)
    values = draw(kind, parameter, (size, repeats), rng)
    means = rng.multinomial(size, np.full(size, 1.0 / size), 1000) @ values / size
    return covers((means, *np.percentile(means, [2.5, 97.5], axis=0)), 1.0)


def change_coverage(sigma: float, size: int, repeats: int = REPEATS, seed: int = SEED) -> float:
    """Coverage of the interval of a change of the RMSE by 20 %."""
    rng = np.random.default_rng(seed)
    common, own = rng.normal(size=(size, repeats, 1)), rng.normal(size=(size, repeats, 2))
    squares = np.exp(sigma * math.sqrt(0.5) * (common + own)) * np.array([1.0, 1.44])
    interval = jackknife(squares, lambda sums: 0.5 * np.log(sums[..., 1] / sums[..., 0]))
    return covers(interval, math.log(1.2))


def correlation_coverage(level: float, size: int, repeats: int = REPEATS, seed: int = SEED) -> float:
    """Coverage of ``correlate`` for 70 steps a trajectory; ``level``: spread of the trajectories' levels."""
    rng = np.random.default_rng(seed)
    truth = 0.5 / math.sqrt(1.0 + level**2)
    sums = []
    for _ in range(size):
        x = rng.normal(size=(repeats, 1, 70))
        y = 0.5 * x + math.sqrt(0.75) * rng.normal(size=x.shape) + level * rng.normal(size=(repeats, 1, 1))
        sums.append(np.stack([correlation_sums(a, b) for a, b in zip(x, y, strict=True)]))
    _, low, high = correlate(np.stack(sums))
    return covers((low, low, high), truth)


def main() -> None:
    print("| quantity | spread between episodes | " + " | ".join(f"{n}" for n in SIZES) + " |")
    print("| --- | --- " + "| --- " * len(SIZES) + "|")

    def row(name: str, spread: str, values: list[float]) -> None:
        print(f"| {name} | {spread} | " + " | ".join(f"{100 * value:.1f} %" for value in values) + " |", flush=True)

    for title, (kind, parameter) in ROWS.items():
        row("mean", title, [mean_coverage(kind, parameter, n) for n in SIZES])
    for sigma in (0.5, 1.0):
        row("change", f"log-normal, sigma {sigma}", [change_coverage(sigma, n) for n in SIZES])
    for level in (0.0, 0.5):
        row("correlation", f"level {level}", [correlation_coverage(level, n, 1000) for n in SIZES])
    row(
        "mean, percentile bootstrap",
        "log-normal, sigma 0.8",
        [percentile_coverage("lognormal", 0.8, n) for n in SIZES],
    )

    print("\nStandard deviation of log NEES/n between episodes, by layer and phase:\n")
    for path in sorted(PROFILES.glob("*.profile.json")):
        rows = json.loads(path.read_text())["healthy_profile"]["statistics"]
        nees = [np.array([v for v in row if v]) for name, row in rows.items() if name.startswith("nees/")]
        spread = [np.log(values).std(ddof=1) for values in nees]
        print(f"{path.name.removesuffix('.profile.json')}: {min(spread):.2f} to {max(spread):.2f}")


if __name__ == "__main__":
    main()
