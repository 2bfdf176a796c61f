"""The stages of training, in the paper's order: dynamics, measurement models, each modality, weights, everything."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor, nn

from beliefscope.filters.batch import Batch, Steps, black_out, shift
from beliefscope.filters.filter import Filter, modality_shape
from beliefscope.filters.models.ekf import VirtualSensor
from beliefscope.filters.models.networks import PICTURES_AT_ONCE, ImageEncoder, fresh
from beliefscope.filters.models.pf import MeasurementModel
from beliefscope.filters.training import losses
from beliefscope.filters.training.resume import Parts, key_of

if TYPE_CHECKING:
    from beliefscope.filters.training.train import Plan

Report = Callable[[str, int, int, float], None]
"""Called with the stage's name, steps done, steps in all, and the loss."""

BLACKOUTS = (0.0, 0.4, 0.8)
"""Chances of a black picture: one is drawn for each training window, and all are evaluated."""

SMALLEST_NOISE = 0.02
"""Of the first process noise, standardised: particles that never moved would soon be one."""

CHECKS = 8
"""Draws of windows over which a validation loss is averaged."""


@dataclass(frozen=True)
class Stage:
    """One stage: its name, and what runs it."""

    name: str
    run: Callable[[], None]


class Trainer:
    """Trains one filter, stage by stage.

    Each stage draws from generators of its own, seeded with its name, so that it does the same whether the stages
    before it ran just now or in a process that was killed.

    Args:
        train, val: steps of the training episodes, and of those on which each stage's best weights are chosen; without
            the latter the last ones are taken.
        blackouts: chances of a black picture, one of which is drawn for each window.
        parts: where dynamics and picture encoders are kept for other filters of the same task, data, plan and seed, or
            taken from; parts_key: names these.
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
        parts: Parts | None = None,
        parts_key: str = "",
    ) -> None:
        self.filter, self.plan, self.seed, self.report = filter_, plan, seed, report
        self.validated: Report = lambda *look: None  # like report, at each look at the validation loss
        self.sets = {"train": train, "val": val}
        self.blackouts = torch.tensor(blackouts)
        self.parts, self.parts_key = parts, parts_key
        self.tables: dict[bytes, Tensor] = {}
        self.device = next(filter_.parameters()).device
        self.generator, self.noise = torch.Generator(), torch.Generator(self.device)

    def stages(self) -> list[Stage]:
        """All stages of this filter, in order. Picture encoders train in ``pictures`` and ``pictures too`` alone."""
        plan, filter_, stages = self.plan, self.filter, []

        def add(name: str, run: Callable[..., None], *arguments: Any) -> None:
            stages.append(Stage(name, partial(run, *arguments)))

        if hasattr(filter_, "dynamics"):
            add("dynamics", self.shared, "dynamics", [filter_.dynamics], self.dynamics)
        encoders = self.picture_encoders()
        if encoders:
            add("pictures", self.shared, "pictures", encoders, self.pictures)
        for name in filter_.names:
            if (module := self.measurement_module(name)) is not None:
                add(f"{name} model", self.model, name, module)
        everything = list(filter_.parameters())
        deciding: tuple[int | None, ...] = (None,)
        if filter_.architecture.fusion == "crossmodal":
            weights = list(filter_.get_submodule("weight_model").parameters())
            rest = [p for n, p in filter_.named_parameters() if not n.startswith("weight_model.")]
            for k, model in enumerate(filter_.names):
                name = f"{model} alone"
                add(name, self.end_to_end, name, rest, plan.alone, plan.window, plan.fine_rate, (k,))
            add("weights", self.end_to_end, "weights", weights, plan.weights, plan.window, plan.rate)
            # A model that is hardly weighed gets hardly a gradient, but Adam's steps are of one size: it would wander
            # off and be no filter of its own any more. So each decides alone now and then.
            deciding = (None, None, *range(len(filter_.names)))
        else:
            name = "through the filter"
            add(name, self.end_to_end, name, everything, plan.alone, plan.window, plan.fine_rate)
        for length, count in zip(plan.lengths, plan.together, strict=True):
            name = f"together, {length} steps"
            add(name, self.end_to_end, name, everything, count, length, plan.fine_rate, deciding)
        if encoders and plan.fine:
            name, length, rate = "pictures too", plan.lengths[-1], plan.fine_rate / 3
            add(name, self.end_to_end, name, everything, plan.fine, length, rate, deciding, False)
        return stages

    def run(self, done: Iterable[str] = (), finished: Callable[[str], None] = lambda name: None) -> None:
        """Every stage whose name is not among ``done``; ``finished`` is called after each."""
        done = set(done)
        for stage in self.stages():
            if stage.name not in done:
                stage.run()
                finished(stage.name)

    def begin(self, name: str) -> None:
        """Seeds the generators for what has this name."""
        digest = hashlib.sha256(f"{self.seed} {name}".encode()).digest()
        seed = int.from_bytes(digest[:7], "big")
        self.generator.manual_seed(seed)
        self.noise.manual_seed(seed)

    def sample(self, part: str, length: int, count: int) -> Batch:
        """Windows of ``train`` or ``val``, in each of which pictures are black with one of the chances."""
        steps = self.sets[part]
        assert steps is not None
        batch = steps.sample(count, length, self.generator)
        chance = self.blackouts[torch.randint(len(self.blackouts), (count,), generator=self.generator)]
        return black_out(batch, chance, self.generator)

    def shifted(self, batch: Batch) -> Batch:
        """Object and hand moved alike, by as much as the object's place varies."""
        return shift(batch, self.filter.task, self.filter.statistics.get_buffer("state_std"), self.generator)

    def picture_encoders(self) -> list[ImageEncoder]:
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
    def remembering(self) -> Iterator[None]:
        """Within, pictures are numbers, and encoders look up what they said to each: a tenth of the time of a stage."""
        encoders, pictures = self.picture_encoders(), dict(self.sets)
        for part, steps in pictures.items():
            self.sets[part] = None if steps is None else steps.numbered()
        # Encoders that are the same, as they are after the stage that trains them, share one table.
        tables = {}
        for encoder in encoders:
            key = torch.cat([p.detach().flatten() for p in encoder.parameters()]).cpu().numpy().tobytes()
            if key not in tables:
                known = self.tables.get(key)
                tables[key] = self.remember(encoder, pictures["train"]) if known is None else known
            encoder.table = tables[key]
        self.tables = tables
        try:
            yield
        finally:
            self.sets = pictures
            for encoder in encoders:
                encoder.table = None

    @torch.no_grad()
    def remember(self, encoder: ImageEncoder, steps: Steps | None) -> Tensor:
        """(pictures + 1, units) features of every picture in the steps' arrays, and of a black one."""
        assert steps is not None
        modality = next(m for m, values in steps.observations.items() if values.dtype == torch.uint8)
        pictures = steps.observations[modality]
        everything = [*pictures.split(PICTURES_AT_ONCE), torch.zeros_like(pictures[:1])]
        return torch.cat([encoder(self.filter.statistics.standardise(modality, part)) for part in everything])

    def shared(self, name: str, modules: Sequence[nn.Module], trained: Callable[[], None]) -> None:
        """A part that does not depend on the filter around it: taken from ``parts``, or trained and kept there.

        It begins with weights that depend on the seed alone, so that it is the same in every filter.
        """
        description = [(n, tuple(p.shape)) for n, p in modules[0].named_parameters()]
        key = key_of(part=name, shapes=description, of=self.parts_key)
        tensors = self.parts.load(key) if self.parts is not None else None
        if tensors is None:
            with torch.random.fork_rng(devices=[]):
                torch.manual_seed(self.seed)
                fresh(modules[0])
            trained()
            tensors = modules[0].state_dict()
            if self.parts is not None:
                self.parts.save(key, tensors)
        for module in modules:
            module.load_state_dict(tensors)

    def dynamics(self) -> None:
        """Squared error of 1, 4, 8, 16 steps ahead from the truth."""
        for length in (1, 4, 8, 16):
            self.optimise(
                f"dynamics, {length} steps",
                self.filter.dynamics.parameters(),
                self.plan.dynamics,
                self.plan.rate,
                lambda part, length=length: losses.prediction(  # type: ignore[misc]
                    self.filter, self.shifted(self.sample(part, length, 4 * self.plan.batch))
                ),
            )
            if length == 1:
                self.residual_noise()

    @torch.no_grad()
    def residual_noise(self) -> None:
        """Process noise begins as what the dynamics leave unexplained in one step, which is found at once."""
        filter_ = self.filter
        self.begin("noise")
        batch = self.sample("train" if self.sets["val"] is None else "val", 1, 64 * self.plan.batch)
        control = filter_.dynamics.control_part(filter_.statistics.standardise("control", batch.controls[0]))
        predicted = filter_.dynamics(filter_.statistics.standardise("state", batch.previous), control)
        residual = (predicted - losses.state(filter_, batch)[0]).square().mean(0).sqrt()
        filter_.dynamics.log_noise.copy_(residual.clamp_min(SMALLEST_NOISE).log())

    def pictures(self) -> None:
        """The first encoder learns to tell the state through a linear readout, which is thrown away.

        All others begin as it is: no encoder has to find out anew what another knows. It is far faster than through
        likelihoods or the filter.
        """
        modality = next(m for m in self.filter.task.modalities if len(modality_shape(self.filter.task, m)) == 2)
        encoder, units = self.picture_encoders()[0], self.filter.architecture.units
        self.begin("readout")
        readout = nn.Linear(units, self.filter.n)
        nn.init.normal_(readout.weight, std=units**-0.5, generator=self.generator)
        nn.init.zeros_(readout.bias)
        readout.to(self.device)

        def loss(part: str) -> Tensor:
            steps = self.sets[part]
            assert steps is not None
            batch = steps.sample(4 * self.plan.batch, 1, self.generator)
            picture = self.filter.statistics.standardise(modality, batch.observations[modality][0])
            return (readout(encoder(picture)) - losses.state(self.filter, batch)[0]).square().mean()

        chosen = [*encoder.parameters(), *readout.parameters()]
        self.optimise("pictures", chosen, self.plan.pictures, self.plan.rate, loss)

    def model(self, name: str, module: VirtualSensor | MeasurementModel) -> None:
        """EKF: the virtual sensor regresses the state. PF: see ``losses.likelihood``."""
        sees = self.sees(name)
        encoders = {id(p) for e in self.picture_encoders() for p in e.parameters()}
        chosen = [p for p in module.parameters() if id(p) not in encoders]
        size = (8 if sees and isinstance(module, MeasurementModel) else 4) * self.plan.batch

        def loss(part: str) -> Tensor:
            batch = self.sample(part, 1, size)
            if not sees:
                batch = self.shifted(batch)
            if isinstance(module, VirtualSensor):
                return (module(self.filter.observations(batch))[0] - losses.state(self.filter, batch)).square().mean()
            return losses.likelihood(self.filter, module, batch, self.noise)

        # Without decay, what has no picture learns the training trajectories by heart.
        decay = 0.0 if sees else 0.01
        with self.remembering():
            self.optimise(f"{name} model", chosen, self.plan.models, 2 * self.plan.rate, loss, decay)

    def end_to_end(
        self,
        stage: str,
        parameters: Iterable[nn.Parameter],
        count: int,
        length: int,
        rate: float,
        deciding: Sequence[int | None] = (None,),
        remembered: bool = True,
    ) -> None:
        """Backpropagation through ``length`` steps of the filter; through picture encoders only if not remembered.

        Args:
            deciding: models that decide alone, one of which is drawn for each step; None is the fused filter.
        """
        filter_, plan = self.filter, self.plan

        def loss(part: str) -> Tensor:
            k = deciding[int(torch.randint(len(deciding), (), generator=self.generator))]
            batch = self.sample(part, length, max(1, 16 * plan.batch // length))
            if not any(self.sees(name) for name in (filter_.names if k is None else [filter_.names[k]])):
                batch = self.shifted(batch)
            evidence = filter_.encode(batch)
            if k is not None:
                evidence = evidence.only(k)
            return losses.through_filter(filter_, evidence, batch, self.noise, plan.particles, plan.likelihood_weight)

        chosen = list(parameters)
        if not remembered:
            self.optimise(stage, chosen, count, rate, loss)
            return
        encoders = {id(p) for e in self.picture_encoders() for p in e.parameters()}
        with self.remembering():
            rest = [p for p in chosen if id(p) not in encoders]
            self.optimise(stage, rest, count, rate, loss)

    def sees(self, name: str) -> bool:
        """Whether a measurement model looks at pictures."""
        return any(len(modality_shape(self.filter.task, modality)) == 2 for modality in name.split("+"))

    def optimise(
        self,
        stage: str,
        parameters: Iterable[nn.Parameter],
        count: int,
        rate: float,
        loss: Callable[[str], Tensor],
        decay: float = 0.0,
    ) -> None:
        """``count`` steps of Adam on these parameters, with weight decay; all others stay as they are.

        Every ``plan.check`` steps the loss on ``val`` is taken, always on the same draws; the best weights are kept,
        those it began with among them, and the stage ends early after ``plan.patience`` looks that brought no better.
        """
        self.begin(stage)
        chosen = list(parameters)
        self.filter.requires_grad_(False)
        for parameter in chosen:
            parameter.requires_grad_(True)
        # One number that scales all else, and logarithmic: at the networks' pace it would not get anywhere.
        noise = [p for n, p in self.filter.named_parameters() if n == "dynamics.log_noise" and p.requires_grad]
        networks = [p for p in chosen if all(p is not q for q in noise)]
        groups: list[dict[str, Any]] = [{"params": networks}, {"params": noise, "lr": 10 * rate, "weight_decay": 0.0}]
        optimiser = torch.optim.AdamW(groups, lr=rate, weight_decay=decay)
        schedule = torch.optim.lr_scheduler.LinearLR(optimiser, 1.0, 0.05, total_iters=max(count, 1))
        looks = self.sets["val"] is not None and count > 0
        best, kept, since = self.checked(stage, loss) if looks else 0.0, [p.detach().clone() for p in chosen], 0
        for done in range(count):
            optimiser.zero_grad(set_to_none=True)
            value = loss("train")
            value.backward()
            norm = nn.utils.clip_grad_norm_(chosen, 5.0)
            # One step whose gradient overflowed must not spoil the weights.
            if torch.isfinite(norm):
                optimiser.step()
            schedule.step()
            if self.report is not None:
                self.report(stage, done + 1, count, float(value.detach()))
            if not looks or ((done + 1) % self.plan.check and done + 1 < count):
                continue
            checked = self.checked(stage, loss)
            self.validated(stage, done + 1, count, checked)
            since += 1
            if checked < best:
                best, kept, since = checked, [p.detach().clone() for p in chosen], 0
            elif since >= self.plan.patience:
                if self.report is not None:
                    self.report(stage, count, count, float(value.detach()))
                break
        if looks:
            with torch.no_grad():
                for parameter, value in zip(chosen, kept, strict=True):
                    parameter.copy_(value)

    @torch.no_grad()
    def checked(self, stage: str, loss: Callable[[str], Tensor]) -> float:
        """The loss on ``val``; leaves the generators as they were."""
        states = self.generator.get_state(), self.noise.get_state()
        self.begin(f"{stage}, validation")
        total = sum(float(loss("val")) for _ in range(CHECKS)) / CHECKS
        self.generator.set_state(states[0])
        self.noise.set_state(states[1])
        return total
