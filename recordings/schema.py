"""What is in a recording: its entities and its properties. ``docs/recordings.md`` is tested against this.

Paths under ``trace/`` and ``observations/`` hold the trace's own numbers (SI units, stored types) and are what an
import reads. All other paths are drawn from them, for the eye: the page's units (cm, degrees), colours, markers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

APPLICATION = "beliefscope"
FORMAT_VERSION = 1
"""Raised when a path changes its meaning or goes. A new path or property alone does not raise it."""

GROWING = -1
"""The property ``steps`` of a recording whose run goes on, or was killed."""

HEADER = "__properties/beliefscope"
"""Where Rerun keeps the recording property ``beliefscope``."""

STEP, TIME = "step", "time"
"""The two timelines: the trace's index t, and t * dt as a duration."""

Needs = Literal[
    "always",
    "modalities",
    "covariance",
    "weights",
    "acting",
    "ekf",
    "pf",
    "maps",
    "diagnostics",
    "replay",
    "bodies",
    "ghost",
]


@dataclass(frozen=True)
class Entity:
    """One row of the schema.

    Attributes:
        path: with ``{component}`` of the state, ``{modality}``, ``{source}`` (``fused`` or a modality), ``{key}`` of an
            observation, ``{layer}`` of a likelihood map, ``{diagnostic}`` and the names of what it shows.
        archetype: Rerun's, or ``Trace`` for numbers that no view of Rerun's draws.
        shape: of one step; T steps, K modalities, n components, M particles, c controls, S cells a side of a map,
            W weights a modality, B bounds.
        unit: of the numbers as stored.
        needs: what the trace must have for the path to be there; ``ekf`` is a UKF as well.
        meaning: one line for the documentation.
    """

    path: str
    archetype: str
    shape: str
    unit: str
    needs: Needs
    meaning: str

    @property
    def static(self) -> bool:
        """Whether it is one value for the whole recording."""
        return self.shape.endswith("static")


TRACE_COMPONENT = "Trace:values"
"""Component of the archetype ``Trace``: one row a step, the array flattened in C order, in its own type."""

SCHEMA: tuple[Entity, ...] = (
    # The numbers: read back exactly.
    Entity("trace/states", "Trace", "(n,)", "m, rad", "always", "true state"),
    Entity("trace/controls", "Trace", "(c,)", "task's", "always", "control that led to this step"),
    Entity("trace/contact", "Trace", "()", "bool", "always", "whether the robot truly touched the object"),
    Entity("trace/qpos", "Trace", "(nq,)", "m, rad", "replay", "joint positions for the replay"),
    Entity("trace/estimate_mean", "Trace", "(n,)", "m, rad", "always", "fused posterior mean"),
    Entity(
        "trace/estimate_covariance",
        "Trace",
        "(n, n)",
        "m, rad",
        "always",
        "fused posterior covariance; NaN without one",
    ),
    Entity("trace/modality_mean", "Trace", "(K, n)", "m, rad", "modalities", "each modality's own mean"),
    Entity("trace/modality_covariance", "Trace", "(K, n, n)", "m, rad", "modalities", "each modality's own covariance"),
    Entity("trace/start_mean", "Trace", "(n,), static", "m, rad", "always", "mean before step 0"),
    Entity("trace/start_covariance", "Trace", "(n, n), static", "m, rad", "always", "covariance before step 0"),
    Entity("trace/weights", "Trace", "(K, W)", "1", "weights", "fusion weights beta as the network gave them"),
    Entity("trace/acting", "Trace", "(K, W)", "1", "acting", "share of each modality as it acted"),
    Entity("trace/predicted_mean", "Trace", "(K, n)", "m, rad", "ekf", "mean before the observation"),
    Entity("trace/predicted_covariance", "Trace", "(K, n, n)", "m, rad", "ekf", "covariance before the observation"),
    Entity("trace/observation_mean", "Trace", "(K, n)", "m, rad", "ekf", "virtual sensors' z"),
    Entity("trace/observation_covariance", "Trace", "(K, n, n)", "m, rad", "ekf", "virtual sensors' R"),
    Entity("trace/particles", "Trace", "(M, n)", "m, rad", "pf", "predicted particles"),
    Entity("trace/prior_log_weights", "Trace", "(M,)", "log", "pf", "normalised weights before the observation"),
    Entity("trace/log_weights", "Trace", "(M,)", "log", "pf", "normalised weights after it, before resampling"),
    Entity("trace/log_likelihood", "Trace", "(K, M)", "log", "pf", "of each particle, not normalised"),
    Entity("trace/ancestors", "Trace", "(M,)", "index", "pf", "particle each resampled one came from"),
    Entity("observations/{key}", "Image or Scalars", "task's", "task's", "always", "what the filter saw"),
    # The world: metres, z up; the plane carries the belief over the task's two map components.
    Entity("world", "ViewCoordinates", "static", "m", "always", "right-handed, z up"),
    Entity("world/effector", "Points3D", "(3,)", "m", "always", "end effector"),
    Entity("world/plane", "Transform3D", "static", "m", "always", "height at which the belief is drawn"),
    Entity("world/plane/truth", "Points3D", "(1, 3)", "m", "always", "true position"),
    Entity("world/plane/{source}/mean", "Points3D", "(1, 3)", "m", "always", "estimated position"),
    Entity("world/plane/{source}/ellipse", "Ellipsoids3D", "(1, 3)", "m", "covariance", "2 sigma contour and its axes"),
    Entity(
        "world/bodies/{body}",
        "Transform3D",
        "(3,), (3, 3)",
        "m",
        "bodies",
        "where each body of robot and object was, with its shape as a static `Mesh3D`",
    ),
    Entity(
        "world/object/{state}",
        "Boxes3D or Cylinders3D",
        "(1, 3)",
        "m",
        "ghost",
        "the object at the state `truth` or `fused`",
    ),
    Entity("world/plane/particles", "Points3D", "(M, 3)", "m", "pf", "coloured by posterior weight"),
    Entity(
        "world/plane/map", "GridMap", "(s, s)", "u8", "maps", "fused map where it belongs; s is S, or every second cell"
    ),
    # The plots: degrees and centimetres.
    Entity("states/{component}/truth", "Scalars", "()", "cm or deg", "always", "true value"),
    Entity("states/{component}/{source}", "Scalars", "()", "cm or deg", "always", "estimated value"),
    Entity("states/{component}/two_sigma", "Scalars", "(2,)", "cm or deg", "covariance", "fused mean - and + 2 sigma"),
    Entity("errors/position/{source}", "Scalars", "()", "cm", "always", "distance from the true position"),
    Entity("errors/{angle}/{source}", "Scalars", "()", "deg", "always", "absolute error of each angle"),
    Entity("weights/{modality}", "Scalars", "(W,)", "1", "weights", "beta, one series a column"),
    Entity("acting/{modality}", "Scalars", "(W,)", "1", "acting", "acting share, one series a column"),
    Entity("contact", "StateChange", "()", "text", "always", "`contact` or `free`, where it changes"),
    Entity("diagnostics/effective_sample_size", "Scalars", "()", "particles", "pf", "1 / sum of squared weights"),
    # The diagnostics: what the page and a figure show of each.
    Entity(
        "diagnostics/{diagnostic}/about",
        "TextDocument",
        "static",
        "text",
        "diagnostics",
        "what it says: its question, verdict and tables",
    ),
    Entity(
        "diagnostics/{diagnostic}/curves/{chart}/{curve}",
        "Scalars",
        "()",
        "in about",
        "diagnostics",
        "a curve of one of its charts",
    ),
    Entity(
        "diagnostics/{diagnostic}/bounds/{chart}",
        "Scalars",
        "(B,)",
        "in about",
        "diagnostics",
        "bounds between which a chart's curves should lie, at the first and last step",
    ),
    Entity(
        "diagnostics/{diagnostic}/bands/{kind}",
        "StateChange",
        "()",
        "text",
        "diagnostics",
        "whether the step is of that kind, where it changes",
    ),
    Entity(
        "diagnostics/{diagnostic}/plots/{plot}",
        "EncodedImage",
        "static",
        "PNG",
        "diagnostics",
        "what is not over time, drawn",
    ),
    Entity(
        "diagnostics/{diagnostic}/pictures/{picture}",
        "EncodedImage",
        "static",
        "PNG",
        "diagnostics",
        "what is per pixel, drawn with its scale",
    ),
    # The maps: at the steps they were made for.
    Entity("maps/{layer}", "DepthImage", "(S, S)", "u8", "maps", "255 x likelihood / its maximum; top row: largest y"),
    Entity("maps/{layer}/log_peak", "Scalars", "()", "log", "maps", "log-likelihood of the maximum"),
    Entity("maps/{layer}/truth", "Boxes2D", "(1, 2)", "cells", "maps", "true position on the map"),
    Entity("maps/{layer}/estimate", "Boxes2D", "(1, 2)", "cells", "maps", "this layer's estimate on the map"),
    Entity("about", "TextDocument", "static", "text", "always", "what is shown, in words"),
)

PROPERTIES: dict[str, str] = {
    "format_version": "version of this schema",
    "versions": "JSON: versions of beliefscope, rerun-sdk and numpy that wrote the file",
    "task": "name of the task",
    "filter": "name of the filter",
    "kind": "`ekf`, `ukf`, `pf`, `lstm`, or `foreign` for a filter from outside",
    "modalities": "JSON list: the K modalities in order",
    "episode_index": "index in its data set",
    "steps": "T, rows of every path under `trace/` and `observations/` that is not static; -1 while a live run goes on",
    "dt": "seconds a step",
    "seed": "seed of the filter's randomness",
    "checkpoint_hash": "SHA-256 of the checkpoint's file",
    "data_hash": "SHA-256 of the episode",
    "faults": "JSON list: the faults its sensors were given, in order; not there in older recordings",
    "settings": "JSON: the filter's settings",
    "episode": "JSON: the episode's seed, split and provenance",
    "shapes": "JSON: stored path -> shape and type of one step",
}
"""Properties of the recording (``property:beliefscope:...`` in Rerun's own queries)."""

EARLIER_PROPERTIES = ("recipe",)
"""Properties that earlier versions wrote in place of ``faults``; still read."""
