"""The arrays that the pictures of one plan are drawn from, computed once."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from realsim_capture_plans.planning import view_quality
from realsim_capture_plans.planning.metrics import plan_metrics
from realsim_capture_plans.planning.record import CapturePlan
from realsim_capture_plans.planning.tour_time import TourSamples, TourTime
from realsim_capture_plans.planning.view_quality import Sensor, sensor_of

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False, kw_only=True, slots=True)
class PlanCurves:
    """A plan with what is drawn of it."""

    plan: CapturePlan
    metrics: dict[str, float]
    sensor: Sensor
    tour: TourTime
    samples: TourSamples
    """Configurations along the tour, as moves are checked."""
    clearance: dict[str, Array]
    """Per group (M,) [m] at the samples."""
    in_view: Array
    """(N,) share of the scene's volume in each image."""
    depth_noise_m: Array
    """(N,) at the scene's centre [m]."""
    radius_m: Array
    """(N,) camera to the scene's centre [m]."""
    sigma: Array
    """(N,) least singular value of the Jacobian."""

    @classmethod
    def of(cls, plan: CapturePlan, metrics: dict[str, float] | None = None) -> "PlanCurves":
        """Return the arrays of a plan; metrics that are not given are computed."""
        model = plan.collision_model()
        sensor = sensor_of(plan)
        tour = TourTime.of(plan)
        samples = tour.samples(plan.config.edge_step_rad)
        points = view_quality.scene_points(plan)
        found = model.clearance(samples.joints)
        return cls(
            plan=plan,
            metrics=plan_metrics(plan, model, sensor=sensor) if metrics is None else metrics,
            sensor=sensor,
            tour=tour,
            samples=samples,
            clearance={g: d for g, d in found.items() if np.any(np.isfinite(d))},
            in_view=view_quality.seen(plan, points, sensor).mean(axis=1),
            depth_noise_m=sensor.depth_noise(view_quality.centre_depth(plan)),
            radius_m=np.linalg.norm(plan.Ts_base_cam[:, :3, 3] - plan.center_world, axis=-1),
            sigma=plan.chain.sigma_min(plan.joints),
        )
