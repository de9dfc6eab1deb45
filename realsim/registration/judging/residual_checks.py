"""Numbers of one object from the residuals of its patches, against the level of its session."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from realsim.geometry.robust import mad_sigma
from realsim.registration.judging.surface_residuals import ResidualConfig, SurfaceResiduals

Array = NDArray[np.float64]


def error_level_m(residuals: Sequence[SurfaceResiduals], config: ResidualConfig) -> float:
    """Return the level of error that the objects of a session share [m].

    The median over objects of 1.48 * median |m| of their patches, freed of its standard error:
    half of the objects, and of each half of its patches, may be wrong without raising it. Of too
    few objects it is what depth of that distance must be expected to be off by.
    """
    least, most = config.level_m
    own: list[float] = []
    depths: list[float] = []
    for r in residuals:
        if np.any(r.measured):
            spread = mad_sigma(r.mean_m[r.measured])
            noise = float(np.median(r.sigma_m[r.measured]))
            own.append(float(np.sqrt(max(0.0, spread**2 - noise**2))))
            depths.append(r.depth_m)
    if not own:
        return least
    if len(own) < config.level_objects:
        level = config.level_per_m * float(np.median(depths)) ** 2
    else:
        level = float(np.median(own))
    return float(np.clip(level, least, most))


def wrong_bound_m(level_m: float, config: ResidualConfig) -> float:
    """Return the mean residual beyond which a patch is wrong [m]."""
    return max(config.wrong_m, config.level_factor * level_m)


def residual_checks(
    residuals: SurfaceResiduals, level_m: float, config: ResidualConfig
) -> dict[str, float]:
    """Return the robust figures of one object's patches.

    Returns:
        wrong_surface: share of the measured surface whose mean residual is beyond the bound and
            beyond three of its standard errors.
        patch_rms_mm: RMS of the patch means beyond their standard errors.
        patch_rms: the same as a share of the bound.
        wrong_patch_mm2: largest connected wrong piece of surface.
        looked_through: share of the surface that views looked at through which they saw.
        measured_surface: share of the surface that has a mean.
        residual_bound_mm: the bound.
        NaN where nothing was measured or looked at.
    """
    r, areas = residuals, residuals.patches.areas_mm2
    measured, bound = r.measured, wrong_bound_m(level_m, config)
    through = _looked_through(r, config)
    watched = r.looks[:, :2].sum(axis=1) > 0
    checks = {
        "wrong_surface": float("nan"),
        "patch_rms_mm": float("nan"),
        "patch_rms": float("nan"),
        "wrong_patch_mm2": float("nan"),
        "looked_through": _share(areas, through & watched, watched),
        "measured_surface": _share(areas, measured, np.ones(len(areas), dtype=np.bool_)),
        "residual_bound_mm": 1e3 * bound,
    }
    if not np.any(measured):
        return checks
    size = np.abs(np.where(measured, r.mean_m, 0.0))
    wrong = measured & (size > bound)
    wrong[measured] &= size[measured] > config.wrong_sigmas * r.sigma_m[measured]
    beyond = np.square(r.mean_m[measured]) - np.square(r.sigma_m[measured])
    rms = float(np.sqrt(max(0.0, np.average(beyond, weights=areas[measured]))))
    return checks | {
        "wrong_surface": _share(areas, wrong, measured),
        "patch_rms_mm": 1e3 * rms,
        "patch_rms": rms / bound,
        "wrong_patch_mm2": _largest_piece(r, wrong),
    }


def _share(areas: Array, part: NDArray[np.bool_], whole: NDArray[np.bool_]) -> float:
    """Return the area of `part` over that of `whole`; NaN if that is nothing."""
    total = float(areas[whole].sum())
    return float(areas[part & whole].sum()) / total if total > 0 else float("nan")


def _looked_through(r: SurfaceResiduals, config: ResidualConfig) -> NDArray[np.bool_]:
    """Return the patches (P,) through which more views saw than ended on them."""
    least = config.through_looks if r.views > config.through_looks else 1
    return (r.looks[:, 1] >= least) & (r.looks[:, 1] > r.looks[:, 0])


def _largest_piece(r: SurfaceResiduals, wrong: NDArray[np.bool_]) -> float:
    """Return the area [mm^2] of the largest connected set of wrong patches of one sign.

    Patches are connected if their cells touch, corners included.
    """
    from scipy.ndimage import label

    largest = 0.0
    for sign in (-1.0, 1.0):
        chosen = wrong & (np.where(wrong, r.mean_m, 0.0) * sign > 0)
        if not np.any(chosen):
            continue
        cells = tuple(r.patches.cells[chosen].T)
        full = np.zeros(r.patches.index.shape[:3], dtype=np.bool_)
        full[cells] = True
        labelled: Any = label(full, structure=np.ones((3, 3, 3)))
        pieces: NDArray[np.int32] = labelled[0]
        areas = np.bincount(pieces[cells], weights=r.patches.areas_mm2[chosen])
        largest = max(largest, float(areas.max()))
    return largest
