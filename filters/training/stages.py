"""The training stages, in the paper's order: dynamics, measurement models, single modalities, weights, end to end."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from beliefscope.filters.batch import Batch, Steps, apply_blackout, shift_positions
from beliefscope.filters.filter import Filter, modality_shape
from beliefscope.filters.models.ekf import VirtualSensor
from beliefscope.filters.models.information import InformationFilter
from beliefscope.filters.models.networks import ImageEncoder, reset_weights
from beliefscope.filters.models.pf import MeasurementModel
from beliefscope.filters.training import losses
from beliefscope.filters.training.encoder_cache import encode_images, weights_key
from beliefscope.filters.training.error_parameters import fit_errors
from beliefscope.filters.training.optimiser import optimiser_step, parameter_groups
from beliefscope.filters.training.plan import BLACKOUTS, Plan, Report
from beliefscope.filters.training.resume import SharedModules, cache_key

MIN_PROCESS_NOISE = 0.02
"""Lower bound of the initial process noise, standardised: without noise, resampled particles collapse onto one."""

VALIDATION_BATCHES = 8
"""Batches of windows over which a validation loss is averaged."""

IMAGES, ALL_PARAMETERS = "image encoders", "end to end, image encoders included"
"""The stages that train image encoders."""


def seed_name(stage: str) -> str:
    """The name that seeds a stage's random numbers: that of earlier versions, so that weights are reproducible."""
    for name, seeded in ((IMAGES, "pictures"), (ALL_PARAMETERS, "pictures too"), ("end to end, ", "together, ")):
        if stage.startswith(name):
            return seeded + stage.removeprefix(name)
    name, comma, rest = stage.partition(",")
    return f"{name.removesuffix(' only')} alone{comma}{rest}" if name.endswith(" only") else stage


@dataclass(frozen=True)
class Stage:
    """One stage: its name, and the function that runs it."""

    name: str
    run: Callable[[], None]


class Trainer:
    """Trains one filter, stage by stage.

    Each stage draws from its own generators, seeded with its name: its result does not depend on whether the stages
    before it ran in this process or in one that was interrupted.

    Args:
        train, val: steps of the training and validation episodes. Each stage keeps the weights that do best on ``val``;
            without ``val``, the last ones.
        blackouts: probabilities of an image blackout; one is drawn for each window.
        shared: store of dynamics models and image encoders, shared by filters of the same task, data, plan and seed;
            shared_key: identifies these.
        on_validation: called like ``report`` with each validation loss.
    """

    def __init__(
        self,
        filter_: Filter,
        train: Steps,
        plan: Plan,
        seed: int,
        val: Steps | None = None,
        report: Report | None = None,
        blackouts: Sequence[float] = BLACKOUTS,
        shared: SharedModules | None = None,
        shared_key: str = "",
        on_validation: Report = lambda *progress: None,
    ) -> None:
        self.filter, self.plan, self.seed, self.report = filter_, plan, seed, report
        self.on_validation = on_validation
        self.sets = {"train": train, "val": val}
        self.blackouts = torch.tensor(blackouts)
        self.shared, self.shared_key = shared, shared_key
        self.tables: dict[bytes, Tensor] = {}
        self.device = next(filter_.parameters()).device
        self.generator, self.noise = torch.Generator(), torch.Generator(self.device)

    def stages(self) -> list[Stage]:
        """All stages of this filter, in order. Image encoders train only in ``IMAGES`` and ``ALL_PARAMETERS``.

        Virtual sensors and dynamics of an ``InformationFilter`` are frozen after their own stages: end to end, they
        would no longer report their own error.
        """
        plan, filter_, stages = self.plan, self.filter, []

        def add(name: str, run: Callable[..., None], *arguments: Any) -> None:
            stages.append(Stage(name, partial(run, *arguments)))

        if hasattr(filter_, "dynamics"):
            part = "dynamics, static components" if filter_.dynamics.static else "dynamics"
            add("dynamics", self.train_shared, part, [filter_.dynamics], self.train_dynamics)
        encoders = self.image_encoders()
        if encoders:
            add(IMAGES, self.train_shared, IMAGES, encoders, self.train_image_encoder)
        for name in filter_.names:
            if (module := self.measurement_module(name)) is not None:
                add(f"{name} model", self.train_model, name, module)
        if isinstance(filter_, InformationFilter):
            if len(filter_.names) > 1:
                weights = [*filter_.get_submodule("weight_model").parameters(), *filter_.error_parameters()]
                name = "weights and errors"
                add(name, self.end_to_end, name, weights, plan.weights, plan.window, plan.rate)
            held_out = self.sets["val"] or self.sets["train"]
            add("calibration", fit_errors, filter_, held_out, plan.calibration, self.seed, self.report)
            return stages
        everything = list(filter_.parameters())
        models: tuple[int | None, ...] = (None,)
        if filter_.architecture.fusion == "crossmodal":
            weights = list(filter_.get_submodule("weight_model").parameters())
            rest = [p for n, p in filter_.named_parameters() if not n.startswith("weight_model.")]
            for k, model in enumerate(filter_.names):
                name = f"{model} only"
                add(name, self.end_to_end, name, rest, plan.single, plan.window, plan.fine_rate, (k,))
            add("weights", self.end_to_end, "weights", weights, plan.weights, plan.window, plan.rate)
            # A model with a small weight gets a small gradient, but Adam's steps have a fixed size: the model would
            # drift until it is useless by itself. Therefore each model is also used without the others at times.
            models = (None, None, *range(len(filter_.names)))
        else:
            name = "through the filter"
            add(name, self.end_to_end, name, everything, plan.single, plan.window, plan.fine_rate)
        for length, count in zip(plan.lengths, plan.together, strict=True):
            name = f"end to end, {length} steps"
            add(name, self.end_to_end, name, everything, count, length, plan.fine_rate, models)
        if encoders and plan.fine:
            length, rate = plan.lengths[-1], plan.fine_rate / 3
            add(ALL_PARAMETERS, self.end_to_end, ALL_PARAMETERS, everything, plan.fine, length, rate, models, False)
        return stages

    def run(self, done: Iterable[str] = (), on_stage_end: Callable[[str], None] = lambda name: None) -> None:
        """Runs every stage whose name is not in ``done``, and calls ``on_stage_end`` after each."""
        done = set(done)
        for stage in self.stages():
            if stage.name not in done:
                stage.run()
                on_stage_end(stage.name)

    def seed_generators(self, name: str) -> None:
        """Seeds the generators from the training's seed and a name."""
        digest = hashlib.sha256(f"{self.seed} {seed_name(name)}".encode()).digest()
        seed = int.from_bytes(digest[:7], "big")
        self.generator.manual_seed(seed)
        self.noise.manual_seed(seed)

    def sample(self, split: str, length: int, count: int) -> Batch:
        """Windows of ``train`` or ``val``, each with image blackouts at one of the probabilities."""
        steps = self.sets[split]
        assert steps is not None
        batch = steps.sample(count, length, self.generator)
        probability = self.blackouts[torch.randint(len(self.blackouts), (count,), generator=self.generator)]
        return apply_blackout(batch, probability, self.generator)

    def shifted(self, batch: Batch) -> Batch:
        """The batch with object and end effector shifted together, by as much as the object's position varies."""
        return shift_positions(batch, self.filter.task, self.filter.statistics.get_buffer("state_std"), self.generator)

    def image_encoders(self) -> list[ImageEncoder]:
        return [m for m in self.filter.modules() if isinstance(m, ImageEncoder)]

    def measurement_module(self, name: str) -> VirtualSensor | MeasurementModel | None:
        """A virtual sensor or measurement model by name; None for a filter that has neither."""
        for bank in ("virtual_sensors", "measurement_models"):
            if hasattr(self.filter, bank):
                module = self.filter.get_submodule(f"{bank}.{name}")
                assert isinstance(module, VirtualSensor | MeasurementModel)
                return module
        return None

    @contextmanager
    def cached_images(self) -> Iterator[None]:
        """Within this context images are indices into tables of the encoders' output, which is ten times faster."""
        encoders, sets = self.image_encoders(), dict(self.sets)
        for split, steps in sets.items():
            self.sets[split] = None if steps is None else steps.with_image_indices()
        tables: dict[bytes, Tensor] = {}
        for encoder in encoders:
            key = weights_key(encoder)
            if key not in tables:
                cached = self.tables.get(key)
                tables[key] = self.encoder_table(encoder, sets["train"]) if cached is None else cached
            encoder.table = tables[key]
        self.tables = tables
        try:
            yield
        finally:
            self.sets = sets
            for encoder in encoders:
                encoder.table = None

    def encoder_table(self, encoder: ImageEncoder, steps: Steps | None) -> Tensor:
        """(images + 1, units) features of every image in the steps' arrays, and of a black one."""
        assert steps is not None
        modality = next(m for m, values in steps.observations.items() if values.dtype == torch.uint8)
        images = steps.observations[modality]
        parts = (images, torch.zeros_like(images[:1]))
        return torch.cat([encode_images(self.filter, modality, encoder, part) for part in parts])

    def train_shared(self, name: str, modules: Sequence[nn.Module], train: Callable[[], None]) -> None:
        """Loads modules that do not depend on the rest of the filter from ``shared``, or trains and stores them.

        Their initial weights depend only on the seed, so that they are the same in every filter.
        """
        shapes = [(n, tuple(p.shape)) for n, p in modules[0].named_parameters()]
        key = cache_key(part=name, shapes=shapes, of=self.shared_key)
        tensors = self.shared.load(key) if self.shared is not None else None
        if tensors is None:
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(self.seed)
                reset_weights(modules[0])
            train()
            tensors = modules[0].state_dict()
            if self.shared is not None:
                self.shared.save(key, tensors)
        for module in modules:
            module.load_state_dict(tensors)

    def train_dynamics(self) -> None:
        """Minimises the squared error over each of the plan's horizons, from the true state."""
        for length in self.plan.horizons:
            self.optimise(
                f"dynamics, {length} steps",
                self.filter.dynamics.parameters(),
                self.plan.dynamics,
                self.plan.rate,
                lambda split, length=length: losses.prediction(  # type: ignore[misc]
                    self.filter, self.shifted(self.sample(split, length, 4 * self.plan.batch))
                ),
            )
            if length == 1:
                self.init_process_noise()

    @torch.no_grad()
    def init_process_noise(self) -> None:
        """Sets the process noise to the standard deviation of the dynamics model's one-step residual."""
        filter_ = self.filter
        self.seed_generators("noise")
        batch = self.sample("train" if self.sets["val"] is None else "val", 1, 64 * self.plan.batch)
        control = filter_.dynamics.control_part(filter_.statistics.standardise("control", batch.controls[0]))
        predicted = filter_.dynamics(filter_.statistics.standardise("state", batch.previous), control)
        residual = losses.errors(filter_, predicted, batch)[0]
        filter_.dynamics.log_noise.copy_(residual.square().mean(0).sqrt().clamp_min(MIN_PROCESS_NOISE).log())

    def train_image_encoder(self) -> None:
        """Trains the first encoder to regress the state through a linear readout, which is then discarded.

        All other encoders start from its weights. This is much faster than training each through likelihoods or the
        filter.
        """
        modality = next(m for m in self.filter.task.modalities if len(modality_shape(self.filter.task, m)) == 2)
        encoder, units = self.image_encoders()[0], self.filter.architecture.units
        self.seed_generators("readout")
        readout = nn.Linear(units, self.filter.n + len(self.filter.angles.indices))
        nn.init.normal_(readout.weight, std=units**-0.5, generator=self.generator)
        nn.init.zeros_(readout.bias)
        readout.to(self.device)

        def loss(split: str) -> Tensor:
            steps = self.sets[split]
            assert steps is not None
            batch = steps.sample(4 * self.plan.batch, 1, self.generator)
            image = self.filter.statistics.standardise(modality, batch.observations[modality][0])
            target = self.filter.angles.features(losses.true_states(self.filter, batch)[0])
            return (readout(encoder(image)) - target).square().mean()

        parameters = [*encoder.parameters(), *readout.parameters()]
        self.optimise(IMAGES, parameters, self.plan.images, self.plan.rate, loss)

    def train_model(self, name: str, module: VirtualSensor | MeasurementModel) -> None:
        """EKF: the virtual sensor regresses the state, or is a likelihood. PF: see ``losses.likelihood``."""
        uses_images, filter_ = self.uses_images(name), self.filter
        longest = min(int(steps.length.max()) for steps in self.sets.values() if steps is not None)
        steps = 1 if uses_images else min(1 + 2 * filter_.history, longest)
        size = (8 if uses_images and isinstance(module, MeasurementModel) else 4) * self.plan.batch

        def loss(split: str) -> Tensor:
            batch = self.sample(split, steps, max(8, 2 * size // (1 + steps)))
            if isinstance(filter_, InformationFilter):
                factors = losses.NOISE_FACTORS if split == "val" else (1.0,)
                return losses.sensor_likelihood(filter_, name, batch, factors)
            if not uses_images:
                batch = self.shifted(batch)
            if isinstance(module, VirtualSensor):
                error = losses.errors(filter_, module(filter_.observations(batch))[0], batch)
                return losses.with_readings(filter_, name, batch, error.square()).mean()
            return losses.likelihood(self.filter, module, batch, self.noise)

        # Without weight decay, a model without images memorises the training episodes.
        decay = 0.0 if uses_images else 0.01
        parameters = self.without_image_encoders(module.parameters())
        with self.cached_images():
            self.optimise(f"{name} model", parameters, self.plan.models, 2 * self.plan.rate, loss, decay)

    def end_to_end(
        self,
        stage: str,
        parameters: Iterable[nn.Parameter],
        count: int,
        length: int,
        rate: float,
        models: Sequence[int | None] = (None,),
        cached: bool = True,
    ) -> None:
        """Backpropagation through ``length`` steps of the filter; through image encoders only if not ``cached``.

        Args:
            models: one is drawn for each step: the index of the only measurement model to use, or None for all.
        """
        filter_, plan = self.filter, self.plan

        def loss(split: str) -> Tensor:
            k = models[int(torch.randint(len(models), (), generator=self.generator))]
            batch = self.sample(split, length, max(1, 16 * plan.batch // length))
            if not any(self.uses_images(name) for name in (filter_.names if k is None else [filter_.names[k]])):
                batch = self.shifted(batch)
            evidence = filter_.encode(batch)
            if k is not None:
                evidence = evidence.only(k)
            return losses.through_filter(filter_, evidence, batch, self.noise, plan.particles, plan.likelihood_weight)

        if not cached:
            self.optimise(stage, parameters, count, rate, loss)
            return
        with self.cached_images():
            self.optimise(stage, self.without_image_encoders(parameters), count, rate, loss)

    def uses_images(self, name: str) -> bool:
        """Whether a measurement model uses images."""
        return any(len(modality_shape(self.filter.task, modality)) == 2 for modality in name.split("+"))

    def without_image_encoders(self, parameters: Iterable[nn.Parameter]) -> list[nn.Parameter]:
        encoders = {id(p) for encoder in self.image_encoders() for p in encoder.parameters()}
        return [p for p in parameters if id(p) not in encoders]

    def optimise(
        self,
        stage: str,
        parameters: Iterable[nn.Parameter],
        count: int,
        rate: float,
        loss: Callable[[str], Tensor],
        decay: float = 0.0,
    ) -> None:
        """``count`` steps of Adam on these parameters, with weight decay; all other parameters are frozen.

        Every ``plan.check`` steps the loss on ``val`` is computed, always on the same samples. The best weights are
        kept, the initial ones included. The stage ends early after ``plan.patience`` validations without improvement.
        """
        self.seed_generators(stage)
        trained = list(parameters)
        self.filter.requires_grad_(False)
        for parameter in trained:
            parameter.requires_grad_(True)
        optimiser = torch.optim.AdamW(parameter_groups(self.filter, trained, rate), lr=rate, weight_decay=decay)
        schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.05, total_iters=max(count, 1))
        validate = self.sets["val"] is not None and count > 0
        best_loss = self.validation_loss(stage, loss) if validate else 0.0
        best, failures = [p.detach().clone() for p in trained], 0
        for step in range(1, count + 1):
            value = optimiser_step(optimiser, trained, loss)
            schedule.step()
            if self.report is not None:
                self.report(stage, step, count, value)
            if not validate or (step % self.plan.check and step < count):
                continue
            validation_loss = self.validation_loss(stage, loss)
            self.on_validation(stage, step, count, validation_loss)
            failures += 1
            if validation_loss < best_loss:
                best_loss, best, failures = validation_loss, [p.detach().clone() for p in trained], 0
            elif failures >= self.plan.patience:
                if self.report is not None:
                    self.report(stage, count, count, value)
                break
        if validate:
            with torch.no_grad():
                for parameter, weights in zip(trained, best, strict=True):
                    parameter.copy_(weights)

    @torch.no_grad()
    def validation_loss(self, stage: str, loss: Callable[[str], Tensor]) -> float:
        """The loss on ``val``; restores the generators' states."""
        states = self.generator.get_state(), self.noise.get_state()
        self.seed_generators(f"{stage}, validation")
        total = sum(float(loss("val")) for _ in range(VALIDATION_BATCHES)) / VALIDATION_BATCHES
        self.generator.set_state(states[0])
        self.noise.set_state(states[1])
        return total
