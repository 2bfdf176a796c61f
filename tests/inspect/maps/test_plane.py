"""Maps over any two components: marginals in closed form, kernel densities of particles, and extents."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from beliefscope.datasets.episode import Episode
from beliefscope.datasets.errors import BadInput
from beliefscope.datasets.store import open_dataset, sample_path
from beliefscope.datasets.task import Component, Task
from beliefscope.filters.checkpoint import load_checkpoint, pretrained_path
from beliefscope.filters.external.unavailable import UnavailableFilter
from beliefscope.inspect.maps.availability import no_maps
from beliefscope.inspect.maps.map_engine import MapEngine
from beliefscope.inspect.maps.plane import plane_of, round_up
from beliefscope.inspect.trace import Trace, trace

N = 5
TASK = Task(
    name="vehicle",
    components=(
        Component("x", "m"),
        Component("y", "m"),
        Component("heading", "rad"),
        Component("vx", "m/s"),
        Component("vy", "m/s", display=("km/h", 3.6)),
    ),
    observations={"gps": (2,), "wheel": (1,)},
    modalities={"satellite": ("gps",), "odometer": ("wheel",)},
    control_size=1,
    dt=0.1,
    map_components=("x", "y"),
    map_half_width=2.0,
    covariates={},
)
T, M = 6, 400


def make_trace(particles: bool = False) -> Trace:
    """Gaussians of two modalities and the fused one with random covariances, and particles drawn from the fused one."""
    rng = np.random.default_rng(0)
    root = np.tril(rng.normal(size=(T, 3, N, N))) * 0.05 + 0.15 * np.eye(N)
    covariance, mean = root @ root.swapaxes(-1, -2), rng.normal(size=(T, 3, N)) * 0.05
    states = np.zeros((T, N), dtype=np.float32)
    observations = {"gps": np.zeros((T, 2), np.float32), "wheel": np.zeros((T, 1), np.float32)}
    episode = Episode(
        task=TASK,
        states=states,
        controls=np.zeros((T, 1), np.float32),
        observations=observations,
        contact=np.zeros(T, bool),
        qpos=np.zeros((T, 0)),
        dt=0.1,
        seed=0,
        split="test",
        provenance={},
    )
    run = Trace(
        episode=episode,
        modalities=() if particles else ("satellite", "odometer"),
        kind="external",
        filter="recorded",
        estimate_mean=mean[:, 2].astype(np.float32),
        estimate_covariance=covariance[:, 2].astype(np.float32),
        modality_mean=(mean[:, :0] if particles else mean[:, :2]).astype(np.float32),
        modality_covariance=(covariance[:, :0] if particles else covariance[:, :2]).astype(np.float32),
        start_mean=states[0],
        start_covariance=np.eye(N, dtype=np.float32),
    )
    if not particles:
        return run
    noise = np.einsum("tij,tmj->tmi", root[:, 2], rng.normal(size=(T, M, N)))
    equal = np.full((T, M), -np.log(M), np.float32)
    return replace(run, particles=(mean[:, 2, None] + noise).astype(np.float32), log_weights=equal)


def engine(run: Trace) -> MapEngine:
    return MapEngine(UnavailableFilter("recorded", "", TASK), run)


def density(
    mean: NDArray[np.float64], covariance: NDArray[np.float64], cells: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Log density of a Gaussian at cells (..., k), by its definition."""
    difference = cells - mean
    squared = np.einsum("...i,ij,...j->...", difference, np.linalg.inv(covariance), difference)
    return np.asarray(-0.5 * squared - 0.5 * np.linalg.slogdet(2.0 * np.pi * covariance)[1])


@pytest.mark.parametrize("names", [("x", "y"), ("heading", "vy"), ("vy", "x")])
@pytest.mark.parametrize("others", ["fixed", "marginal"])
def test_gaussians_equal_their_definition(names: tuple[str, str], others: str) -> None:
    run = make_trace()
    map_ = engine(run).map(2, size=9, quantity="posterior", components=names, others=others)  # type: ignore[arg-type]
    index = [TASK.index(name) for name in names]
    x, y = np.meshgrid(map_.offsets_x.astype(float), map_.offsets_y.astype(float))
    means = np.concatenate([run.modality_mean[2], run.estimate_mean[2][None]]).astype(float)
    covariances = np.concatenate([run.modality_covariance[2], run.estimate_covariance[2][None]]).astype(float)
    cells = np.zeros((9, 9, N))
    cells[..., index[0]], cells[..., index[1]] = x, y
    for layer, mean, covariance in zip(map_.log_likelihood, means, covariances, strict=True):
        if others == "fixed":
            expected = density(mean, covariance, cells)
        else:
            expected = density(mean[index], covariance[np.ix_(index, index)], cells[..., index])
        np.testing.assert_allclose(layer, expected, rtol=1e-4, atol=1e-4)  # float32 values
    assert map_.components == tuple(index)
    assert np.isnan(map_.angle)


def test_several_components_off_the_map_are_integrated_out_by_default() -> None:
    map_ = engine(make_trace()).map(1, size=11)
    assert (map_.others, map_.quantity) == ("marginal", "posterior")
    assert map_.title.startswith("Posterior, heading, vx, vy integrated out. Fused:")


def test_without_single_modality_updates_only_the_fused_posterior_is_drawn() -> None:
    run = make_trace()
    unknown = {name: np.full_like(getattr(run, name), np.nan) for name in ("modality_mean", "modality_covariance")}
    map_ = engine(replace(run, **unknown)).map(2, size=9)  # type: ignore[arg-type]
    assert map_.layers == ("fused",)
    assert map_.title.endswith("Fused: posterior reported by the filter")
    np.testing.assert_array_equal(map_.log_likelihood[0], engine(run).map(2, size=9).log_likelihood[2])


def test_marginal_of_particles_has_their_moments() -> None:
    """The kernel density has mean and covariance of the particles, so has its marginal; it sums to one."""
    run = make_trace(particles=True)
    filter_engine = engine(run)
    map_ = filter_engine.map(3, size=201, components=("x", "y"))
    assert map_.layers == ("fused",)
    assert map_.log_likelihood.shape == (1, 201, 201)
    cell = float(map_.offsets_x[1] - map_.offsets_x[0])
    p = np.exp(map_.log_likelihood[0].astype(float)) * cell**2
    assert p.sum() == pytest.approx(1.0, abs=1e-3)
    assert run.particles is not None
    sample = run.particles[3, :, :2].astype(float)
    mean = np.array([(p.sum(0) @ map_.offsets_x), (p.sum(1) @ map_.offsets_y)])
    np.testing.assert_allclose(mean, sample.mean(0), atol=1e-3)
    variance = (p.sum(0) @ (map_.offsets_x - mean[0]) ** 2, p.sum(1) @ (map_.offsets_y - mean[1]) ** 2)
    np.testing.assert_allclose(variance, sample.var(0), rtol=0.02)


def test_extents_are_round_in_display_units_and_equal_for_equal_units() -> None:
    run = make_trace()
    assert plane_of(run).half_widths == (2.0, 2.0)
    x, vy = plane_of(run, ("x", "vy")).half_widths
    assert x == 2.0
    deviation = np.abs(run.estimate_mean[:, 4]) + 3.0 * np.sqrt(run.estimate_covariance[:, 4, 4])
    assert vy >= deviation.max()
    assert 3.6 * vy == pytest.approx(round_up(3.6 * vy * 0.999))
    assert plane_of(run, ("heading", "vy")).half_widths[0] <= np.pi
    assert [round_up(value) for value in (0.011, 0.02, 3.0, 6.0)] == pytest.approx([0.02, 0.02, 5.0, 10.0])


def test_extent_of_a_map_whose_cells_are_larger_than_the_beliefs_is_that_of_the_run() -> None:
    run = make_trace()
    task = replace(TASK, map_half_width=1000.0)
    wide = replace(run, episode=replace(run.episode, task=task))
    spread = np.abs(run.estimate_mean) + 3.0 * np.sqrt(np.diagonal(run.estimate_covariance, axis1=1, axis2=2))
    half, _ = plane_of(wide).half_widths
    assert spread[:, :2].max() < half < 10.0
    still = replace(wide, estimate_mean=wide.anchors, estimate_covariance=0.0 * wide.estimate_covariance)
    assert plane_of(still).half_widths == (1000.0, 1000.0)


def test_extents_are_those_of_the_steps_with_finite_estimates() -> None:
    run = make_trace()
    mean = np.insert(run.estimate_mean[:-1], 3, np.nan, axis=0)
    assert np.isfinite(plane_of(replace(run, estimate_mean=mean), ("x", "vy")).half_widths).all()
    assert plane_of(replace(run, estimate_mean=np.full_like(mean, np.nan))).half_widths == (2.0, 2.0)


def test_invalid_choices_are_rejected() -> None:
    maps = engine(make_trace())
    with pytest.raises(BadInput, match="component 'vz' of task 'vehicle' does not exist"):
        maps.map(0, components=("x", "vz"))
    with pytest.raises(BadInput, match="one component or two different ones, not x and x"):
        maps.map(0, components=("x", "x"))
    with pytest.raises(BadInput, match="treatment 'mean' of the components"):
        maps.map(0, others="mean")  # type: ignore[arg-type]


def test_particle_filter_over_an_angle_and_integrated() -> None:
    """The networks are evaluated at the same states whatever the axes, and the posterior has a marginal."""
    with open_dataset(sample_path("door")) as data:
        episode = data[next(s.index for s in data.summaries if s.split == "test")]
    checkpoint = load_checkpoint(pretrained_path("door", "crossmodal-pf"))
    run = trace(checkpoint, episode, particles=50)
    maps = MapEngine(checkpoint, run)
    assert no_maps(checkpoint, run) is None
    step, size = 40, 7
    turned = maps.map(step, size=size, components=("hinge_x", "angle"))
    row = size // 2  # the middle row is at the true angle, and the middle of the default map at the true position
    angle = float(run.episode.states[step, 2] + turned.offsets_y[row])
    straight = maps.map(step, angle=angle, size=size)
    np.testing.assert_allclose(turned.log_likelihood[:, row], straight.log_likelihood[:, row], rtol=1e-4, atol=1e-3)
    marginal = maps.map(step, size=135, quantity="posterior", others="marginal")
    cell = float(marginal.offsets_x[1] - marginal.offsets_x[0]) ** 2
    sums = np.exp(marginal.log_likelihood.astype(float)).sum((1, 2)) * cell
    np.testing.assert_allclose(sums, 1.0, atol=0.02)
    assert marginal.title.startswith("Posterior, angle integrated out. Fused: prior times")
    with pytest.raises(BadInput, match="cannot be integrated over components: choose the posterior"):
        maps.map(step, others="marginal")
