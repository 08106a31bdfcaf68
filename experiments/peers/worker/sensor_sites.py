"""Sites of sensors that PySensors chooses."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

_ROUNDING = 1e-6  # m


def sensor_sites(readings: np.ndarray, places: np.ndarray, count: int, distance: float) -> dict[str, Any]:
    """Return the choices of QR and of GQR (Manohar et al. 2018, Karnik et al. 2023) and their durations.

    The basis has as many modes of the centred readings as there are sensors, as PySensors recommends. QR
    ignores the distance.

    Args:
        readings: (F, C), N.
        places: (C, 2), m.
        count: number of sensors.
        distance: least distance of two sensors, m.

    Returns:
        method -> ``sites``, and ``cpu_seconds`` with the time of the basis.
    """
    import pandas as pd
    from pysensors.optimizers import GQR, QR

    centred = readings - readings.mean(axis=0)
    frame = pd.DataFrame(places, columns=["x", "y"])
    near = {
        "constraint_option": "distance",
        "info": frame,
        "X_axis": "x",
        "Y_axis": "y",
        "r": distance - _ROUNDING,
        "all_sensors": np.arange(len(places)),
        "n_sensors": count,
    }
    free = _timed(lambda: _chosen(centred, count, QR()))
    apart = _timed(lambda: _chosen(centred, count, GQR(), **near)) if distance > _ROUNDING else free
    return {"pysensors_qr": free, "pysensors_gqr": apart}


def _chosen(readings: np.ndarray, count: int, optimizer: Any, **settings: Any) -> list[int]:
    from pysensors import SSPOR
    from pysensors.basis import SVD

    model = SSPOR(SVD(n_basis_modes=count, random_state=0), optimizer, n_sensors=count)
    return model.fit(readings, quiet=True, seed=0, **settings).get_selected_sensors().tolist()


def _timed(choose: Callable[[], list[int]]) -> dict[str, Any]:
    began = time.process_time()
    return {"sites": choose(), "cpu_seconds": time.process_time() - began}
