"""Filters of filterpy on the vehicle, with an adapter of the package.

beliefscope trace vehicle --data vehicle.h5 --filter examples/gallery/filterpy_vehicle.py:kalman -o kalman.trace
beliefscope inspect kalman.trace
"""

import numpy as np
from filterpy.kalman import EnsembleKalmanFilter, KalmanFilter, MerweScaledSigmaPoints, UnscentedKalmanFilter
from vehicle import DT, P0, F, H, Q, R

from beliefscope.filters.external.adapter import Adapter
from beliefscope.filters.external.filterpy_filters import FilterPy

ADAPTER = {"batched": False, "absent": "nan", "modalities": tuple(H)}


def with_fix(observations: dict, controls: np.ndarray) -> tuple[dict, np.ndarray]:
    """GPS readings without a fix as NaN."""
    return {**observations, "gps": np.where(observations["fix"] > 0, observations["gps"], np.nan)}, controls


UPDATES = {key: lambda f, z, key=key: f.update(z, R=R[key], H=H[key]) for key in H}


def kalman() -> Adapter:
    filter_ = KalmanFilter(dim_x=4, dim_z=2)
    filter_.F, filter_.Q, filter_.P = F, Q, P0
    return Adapter(FilterPy(filter_, UPDATES, own_start=True), inputs=with_fix, **ADAPTER)


def gated() -> Adapter:
    adapter = kalman()
    filter_ = FilterPy(adapter.module.filter, UPDATES, own_start=True, gate=0.9999)
    return Adapter(filter_, inputs=with_fix, **ADAPTER)


def unscented() -> Adapter:
    points = MerweScaledSigmaPoints(4, alpha=0.1, beta=2.0, kappa=-1.0)
    filter_ = UnscentedKalmanFilter(4, 2, DT, hx=lambda x: x[:2], fx=lambda x, dt: F @ x, points=points)
    filter_.Q, filter_.P, filter_.R = Q, P0, R["gps"]
    update = {"gps": lambda f, z: f.update(z)}
    return Adapter(FilterPy(filter_, update, own_start=True), inputs=with_fix, **(ADAPTER | {"modalities": ("gps",)}))


def ensemble() -> Adapter:
    filter_ = EnsembleKalmanFilter(np.zeros(4), P0, 2, DT, N=50, hx=lambda x: x[:2], fx=lambda x, dt: F @ x)
    filter_.Q, filter_.R = Q, R["gps"]
    filter_ = FilterPy(filter_, {"gps": lambda f, z: f.update(z)}, predict=lambda f, u: f.predict(), own_start=True)
    return Adapter(filter_, inputs=with_fix, **(ADAPTER | {"modalities": ()}))
