"""``states.npz``: everything that is known of the keyframes, so that answers can be had later.

Covariances are kept in single precision, of the symmetric ones a triangle: 1.6 kB a keyframe.
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path
from typing import Final

import numpy as np

from ssm_graph.base.earth import LocalFrame
from ssm_graph.base.errors import DataError
from ssm_graph.base.frozen import Array
from ssm_graph.mission.posterior import Posterior

STATES_NAME: Final = "states.npz"
_DIM: Final = 15
_TRIANGLE: Final = np.tril_indices(_DIM)


def states_bytes(posterior: Posterior) -> bytes:
    """Return the content of ``states.npz``."""
    frame, errors = posterior.frame, posterior.imu_errors
    file = io.BytesIO()
    np.savez(
        file,
        frame=np.array([frame.lat, frame.lon, frame.height]),
        time_s=posterior.time_s,
        R_nb=posterior.R_nb,
        p_n=posterior.p_n,
        v_n=posterior.v_n,
        bias=posterior.bias,
        covariance=posterior.covariance[:, *_TRIANGLE].astype(np.float32),
        neighbour_covariance=posterior.neighbour_covariance.astype(np.float32),
        imu_errors=np.zeros((0, 27)) if errors is None else errors,
    )
    return file.getvalue()


def read_states(folder: Path) -> Posterior:
    """Read ``states.npz`` of a result folder.

    Raises :class:`DataError` where there is none, or one that is damaged.
    """
    path = folder / STATES_NAME
    if not path.is_file():
        raise DataError(
            f"{path}: there is none: answers between keyframes and at other points need the result "
            "of ssm-graph smooth, of this version or later; smooth the mission again; "
            "of a filter's take its own times and place, without --at, --rate, --point, --covariance"
        )
    try:
        with np.load(io.BytesIO(path.read_bytes()), allow_pickle=False) as stored:
            held: dict[str, Array] = {name: stored[name].astype(np.float64) for name in stored}
        covariance = np.empty((len(held["time_s"]), _DIM, _DIM))
        covariance[:, *_TRIANGLE] = held.pop("covariance")
        covariance.mT[:, *_TRIANGLE] = covariance[:, *_TRIANGLE]
        frame = LocalFrame(*held.pop("frame").tolist())
        errors = held.pop("imu_errors")
        return Posterior(
            frame=frame,
            covariance=covariance,
            imu_errors=errors if len(errors) else None,
            **held,
        )
    except (OSError, KeyError, ValueError, TypeError, zipfile.BadZipFile) as error:
        raise DataError(f"{path}: expected the states of a result: {error}") from error
