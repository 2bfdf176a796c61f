"""Schema of a recording: entities and properties. ``docs/recordings.md`` is tested against it.

Paths under ``trace/`` and ``observations/`` hold the arrays of the trace (SI units, original types), which an import
reads. All other paths are derived for display: in cm and degrees, with colours and markers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

APPLICATION = "beliefscope"
FORMAT_VERSION = 1
"""Incremented when a path changes its meaning or is removed, but not for a new path or property."""

GROWING = -1
"""Property ``steps`` of a recording whose run is in progress or was killed."""

HEADER = "__properties/beliefscope"
"""Entity in which Rerun stores the recording property ``beliefscope``."""

STEP, TIME = "step", "time"
"""The two timelines: step index t, and the time since step 0 as a duration: t * dt, or that of the episode."""

Needs = Literal[
    "always",
    "modalities",
    "covariance",
    "weights",
    "effective_weights",
    "points",
    "covariates",
    "contact",
    "time",
    "ekf",
    "sensors",
    "pf",
    "sample",
    "measurements",
    "extra",
    "maps",
    "diagnostics",
    "replay",
    "bodies",
    "outline",
]


@dataclass(frozen=True)
class Entity:
    """One row of the schema.

    Attributes:
        path: with placeholders ``{component}`` of the state, ``{modality}``, ``{source}`` (``fused``, or a modality for
            its single-modality update), ``{key}`` of an observation, ``{layer}`` of a likelihood map, ``{diagnostic}``
            and names of its parts.
        archetype: of Rerun, or ``Trace`` for arrays that no Rerun view displays.
        shape: per step; T steps, K modalities, n components, M particles, c controls, S cells per side of a map,
            W weights per modality, B bounds.
        unit: of the stored numbers.
        needs: property of the trace that the path requires; ``ekf`` includes UKFs; ``sensors`` are virtual ones;
            ``time``: the steps have their own times; ``sample``: only some particles are kept; ``measurements`` and
            ``extra`` come from external filters.
        meaning: one-line description for the documentation.
    """

    path: str
    archetype: str
    shape: str
    unit: str
    needs: Needs
    meaning: str

    @property
    def static(self) -> bool:
        """Whether the entity has one value for the whole recording."""
        return self.shape.endswith("static")


TRACE_COMPONENT = "Trace:values"
"""Component of the archetype ``Trace``: one row per step, the array flattened in C order, in its original type."""

SCHEMA: tuple[Entity, ...] = (
    # Arrays of the trace, stored exactly.
    Entity("trace/states", "Trace", "(n,)", "m, rad", "always", "true state"),
    Entity("trace/controls", "Trace", "(c,)", "task's", "always", "control before this step"),
    Entity("trace/contact", "Trace", "()", "bool", "always", "whether the robot touches the object"),
    Entity("trace/time", "Trace", "()", "s", "time", "time since step 0; absent: steps times dt"),
    Entity("trace/qpos", "Trace", "(nq,)", "m, rad", "replay", "joint positions of the simulation"),
    Entity("trace/estimate_mean", "Trace", "(n,)", "m, rad", "always", "fused posterior mean"),
    Entity(
        "trace/estimate_covariance",
        "Trace",
        "(n, n)",
        "m, rad",
        "always",
        "fused posterior covariance; NaN without one",
    ),
    Entity("trace/modality_mean", "Trace", "(K, n)", "m, rad", "modalities", "mean of each single-modality update"),
    Entity("trace/modality_covariance", "Trace", "(K, n, n)", "m, rad", "modalities", "covariance of each update"),
    Entity("trace/start_mean", "Trace", "(n,), static", "m, rad", "always", "mean before step 0"),
    Entity("trace/start_covariance", "Trace", "(n, n), static", "m, rad", "always", "covariance before step 0"),
    Entity("trace/weights", "Trace", "(K, W)", "1", "weights", "fusion weights beta from the network"),
    Entity("trace/effective_weights", "Trace", "(K, W)", "1", "effective_weights", "modality's share in the posterior"),
    Entity("trace/predicted_mean", "Trace", "(K, n)", "m, rad", "ekf", "mean before the observation"),
    Entity("trace/predicted_covariance", "Trace", "(K, n, n)", "m, rad", "ekf", "covariance before the observation"),
    Entity("trace/observation_mean", "Trace", "(K, n)", "m, rad", "sensors", "measurement z of the virtual sensors"),
    Entity("trace/observation_covariance", "Trace", "(K, n, n)", "m, rad", "sensors", "noise R of the virtual sensors"),
    Entity("trace/particles", "Trace", "(M, n)", "m, rad", "pf", "predicted particles"),
    Entity("trace/prior_log_weights", "Trace", "(M,)", "log", "pf", "normalised weights before the observation"),
    Entity("trace/log_weights", "Trace", "(M,)", "log", "pf", "normalised weights after it, before resampling"),
    Entity("trace/log_likelihood", "Trace", "(K, M)", "log", "pf", "log-likelihood of each particle, unnormalised"),
    Entity("trace/ancestors", "Trace", "(M,)", "index", "pf", "index of the particle before resampling"),
    Entity("trace/all_particles_ess", "Trace", "()", "particles", "sample", "effective sample size of all"),
    Entity("trace/innovation", "Trace", "(K, m)", "task's", "measurements", "innovation of each measurement, or NaN"),
    Entity("trace/innovation_covariance", "Trace", "(K, m, m)", "task's", "measurements", "its predicted covariance S"),
    Entity("trace/accepted", "Trace", "(K,)", "1", "measurements", "whether the gate accepted the measurement"),
    Entity("extra/{name}", "Scalars", "()", "filter's", "extra", "scalar that only this filter has"),
    Entity("observations/{key}", "Image or Scalars", "task's", "task's", "always", "input of the filter"),
    Entity("points/{key}", "Points3D", "(P, 3)", "m", "points", "scan or point cloud in the frame of the sensor"),
    Entity("covariates/{name}", "Scalars", "()", "task's", "covariates", "covariate except contact; NaN: unknown"),
    # The scene: metres, z up. The plane shows the belief over the task's two map components.
    Entity("world", "ViewCoordinates", "static", "m", "always", "right-handed, z up"),
    Entity("world/effector", "Points3D", "(3,)", "m", "always", "end effector"),
    Entity("world/plane", "Transform3D", "static", "m", "always", "plane of the displayed belief"),
    Entity("world/plane/truth", "Points3D", "(1, 3)", "m", "always", "true position"),
    Entity("world/plane/{source}/mean", "Points3D", "(1, 3)", "m", "always", "estimated position"),
    Entity("world/plane/{source}/ellipse", "Ellipsoids3D", "(1, 3)", "m", "covariance", "2 sigma contour and its axes"),
    Entity(
        "world/bodies/{body}",
        "Transform3D",
        "(3,), (4,)",
        "m",
        "bodies",
        "position and quaternion of each body of robot and object, static if fixed; its shape is a static `Mesh3D`",
    ),
    Entity(
        "world/object/{state}",
        "Boxes3D or Cylinders3D",
        "(1, 3)",
        "m",
        "outline",
        "object at the state `truth` or `fused`",
    ),
    Entity("world/plane/particles", "Points3D", "(M, 3)", "m", "pf", "coloured by posterior weight"),
    Entity(
        "world/plane/map", "GridMap", "(s, s)", "u8", "maps", "fused map in the scene; s is S, or less for large maps"
    ),
    # Plots: degrees and centimetres.
    Entity("states/{component}/truth", "Scalars", "()", "cm or deg", "always", "true value"),
    Entity("states/{component}/{source}", "Scalars", "()", "cm or deg", "always", "estimated value"),
    Entity("states/{component}/two_sigma", "Scalars", "(2,)", "cm or deg", "covariance", "fused mean - and + 2 sigma"),
    Entity("errors/position/{source}", "Scalars", "()", "cm or other", "always", "main error of the task"),
    Entity("errors/{angle}/{source}", "Scalars", "()", "deg", "always", "absolute error of each angle"),
    Entity("weights/{modality}", "Scalars", "(W,)", "1", "weights", "beta, one series per column"),
    Entity(
        "effective_weights/{modality}",
        "Scalars",
        "(W,)",
        "1",
        "effective_weights",
        "effective weight, one series per column",
    ),
    Entity("contact", "StateChange", "()", "text", "contact", "`contact` or `free motion`, at changes"),
    Entity("diagnostics/effective_sample_size", "Scalars", "()", "particles", "pf", "1 / sum of squared weights"),
    # Diagnostics.
    Entity(
        "diagnostics/{diagnostic}/about",
        "TextDocument",
        "static",
        "text",
        "diagnostics",
        "question, verdict and tables",
    ),
    Entity(
        "diagnostics/{diagnostic}/curves/{chart}/{curve}",
        "Scalars",
        "()",
        "in about",
        "diagnostics",
        "curve of a chart",
    ),
    Entity(
        "diagnostics/{diagnostic}/bounds/{chart}",
        "Scalars",
        "(B,)",
        "in about",
        "diagnostics",
        "expected bounds of the curves of a chart, at the first and last step",
    ),
    Entity(
        "diagnostics/{diagnostic}/bands/{kind}",
        "StateChange",
        "()",
        "text",
        "diagnostics",
        "phase of the step, at changes",
    ),
    Entity(
        "diagnostics/{diagnostic}/plots/{plot}",
        "EncodedImage",
        "static",
        "PNG",
        "diagnostics",
        "plot that is not over time",
    ),
    Entity(
        "diagnostics/{diagnostic}/images/{image}",
        "EncodedImage",
        "static",
        "PNG",
        "diagnostics",
        "image with its colour scale",
    ),
    # Likelihood maps, at the steps for which they were computed.
    Entity("maps/title", "TextDocument", "static", "text", "maps", "likelihood or posterior, and the fusion rule"),
    Entity("maps/step", "Points2D", "()", "text", "maps", "label in the views of maps: the step of the displayed ones"),
    Entity(
        "maps/{layer}",
        "EncodedDepthImage or LineStrips2D",
        "(S, S)",
        "u8",
        "maps",
        "PNG of 16 bits: 255 x quantity / its maximum",
    ),
    Entity("maps/{layer}/log_peak", "Scalars", "()", "log", "maps", "log of the quantity at the maximum"),
    Entity("maps/{layer}/truth", "Boxes2D", "(1, 2)", "cells", "maps", "true position on the map"),
    Entity("maps/{layer}/estimate", "Boxes2D", "(1, 2)", "cells", "maps", "estimate of the layer on the map"),
    Entity("about", "TextDocument", "static", "text", "always", "description of the recording"),
)

PROPERTIES: dict[str, str] = {
    "format_version": "version of this schema",
    "versions": "JSON: versions of beliefscope, rerun-sdk and numpy that wrote the file",
    "task": "name of the task",
    "definition": "definition of the task, JSON",
    "filter": "name of the filter",
    "kind": "`ekf`, `ukf`, `pf`, `lstm`, `transformer`, or `external` for an external filter",
    "modalities": "JSON list: the K modalities in order",
    "episode_index": "index in the data set",
    "steps": "T, rows of every path under `trace/` and `observations/` that is not static; -1 during a live run",
    "dt": "seconds per step",
    "seed": "seed of the filter",
    "checkpoint_hash": "SHA-256 of the checkpoint file",
    "data_hash": "SHA-256 of the episode",
    "faults": "JSON list: injected sensor faults in order; missing in older recordings",
    "settings": "JSON: settings of the filter",
    "episode": "JSON: seed, split and provenance of the episode",
    "shapes": "JSON: stored path -> shape per step, and type",
}
"""Properties of the recording (``property:beliefscope:...`` in Rerun queries)."""

EARLIER_PROPERTIES = ("recipe",)
"""Properties that earlier versions wrote in place of ``faults``; still read."""
