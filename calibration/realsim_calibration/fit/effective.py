"""The camera's place for this arm as it moves here: what the arm gets wrong everywhere cancels.

An error that is the same in all poses looks like another place of camera and target, and the fit
shares it out among X, Z and the robot's map as their priors like it: X alone is known no better
than this share. Where the camera looks from at the calibrated poses does not depend on it. Its
representative is the X (with a Z) that shows every view where fit and map together show it,

    (x, z) = argmin sum_i |J_i (x, z) - E_i B_i w|^2  =  K w,        X_here = X Exp(x)

with the derivatives of the views' pixels by X and Z (J) and by the robot's errors (E) of
`view_system`. It is linear in w, so its covariance is P C P^T, P = [1 0 K], C that of the fit's
noise. Smooth errors of the arm that the fit does not model move the estimate about as they move
the true X_here, and what they leave differs from view to view, which the jackknife counts.
"""

from dataclasses import dataclass

import numpy as np

from realsim.arrays import Array
from realsim.errors import DegenerateError
from realsim_calibration.fit.joint_solve import JointState
from realsim_calibration.fit.linear_model import LinearFit, LinearModel
from realsim_calibration.fit.robot_error import ErrorBasis
from realsim_calibration.fit.view_system import SHARED
from realsim_calibration.results import Stretch

PLACES = 12
"""X and Z."""
OUTER_SHARE = 0.25
"""Views that are held out to see how far a map may be stretched."""
FEW_OUTER = 2
"""Fewer outer views say nothing."""


def places_of(model: LinearModel, columns: Array) -> Array:
    """Return K (12, q): twists of X and Z that show the views as errors (views, 6, q) do."""
    J = model.J[:, :, :PLACES]
    seen = np.einsum("nrs,nsq->nrq", model.D, columns)
    normal = np.einsum("nra,nrb->ab", J, J)
    return np.asarray(np.linalg.solve(normal, np.einsum("nra,nrq->aq", J, seen)), np.float64)


def projection(model: LinearModel, basis: ErrorBasis | None) -> Array:
    """Return P (12, 29 + p): twists of X and Z for this arm per parameter of a fit."""
    smooth = np.zeros((PLACES, 0)) if basis is None else places_of(model, basis.columns)
    rest = np.zeros((PLACES, model.shared - PLACES))
    return np.concatenate([np.eye(PLACES), rest, smooth], -1)


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PlainFit:
    """A calibration for programs that know no robot map."""

    name: str
    state: JointState
    held_out_px: float
    """RMS of the views, each predicted without it and without a map [px]."""


def plain_fits(
    model: LinearModel, none: LinearFit, sigma: float, mapped: LinearFit, basis: ErrorBasis | None
) -> list[PlainFit]:
    """Return the joint fits that need no map, the one with the robot's noise first.

    "joint" weighs the robot's noise, "pixels" takes the robot for exact, and "effective" is the fit
    with a map, the map's mean effect put into X and Z.
    """
    steps = {"joint": none, "pixels": model.fit(None, np.zeros(2), sigma)}
    shared = {name: (fit.step, fit.step + fit.away) for name, fit in steps.items()}
    if basis is not None:
        P = projection(model, basis)
        shared["effective"] = (_folded(P, mapped.step), _folded(P, mapped.step + mapped.away))
    return [
        PlainFit(
            name=name, state=model.state.moved(step),
            held_out_px=float(np.sqrt(np.mean(model.predicted(None, without) ** 2))),
        )
        for name, (step, without) in shared.items()
    ]  # fmt: skip


def _folded(P: Array, steps: Array) -> Array:
    """Return steps (..., 29) of shared parameters, the map's part put into X and Z."""
    return np.concatenate([steps @ P.T, steps[..., PLACES:SHARED]], -1)


def stretch(
    model: LinearModel, mapped: LinearFit, basis: ErrorBasis, none: LinearFit, features: Array
) -> Stretch | None:
    """Return how map and no map predict the outermost views, None where the rest is too few.

    Args:
        model: the views.
        mapped: the fit with the map.
        basis: the map's basis.
        none: the fit without one.
        features: (views, 12) of the poses, centred: outermost is furthest from the middle.
    """
    count = int(OUTER_SHARE * len(features))
    if count < FEW_OUTER:
        return None
    outer = np.sort(np.argsort(np.linalg.norm(features, axis=-1))[-count:])
    px: list[float] = []
    for fit, errors in ((mapped, basis), (none, None)):
        try:
            step = fit.step + fit.without(outer)
        except DegenerateError:
            return None
        seen = model.predicted(errors, np.broadcast_to(step, fit.away.shape))[outer]
        px.append(float(np.sqrt(np.mean(seen**2))))
    views = tuple(model.problem.setup.views[k].index for k in outer)
    return Stretch(views=views, map_px=px[0], plain_px=px[1])
