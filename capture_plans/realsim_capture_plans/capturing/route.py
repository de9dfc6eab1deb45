"""The ways that the arm may go: along the plan's checked moves, or lines checked on the spot."""

import numpy as np
from numpy.typing import NDArray

from realsim_capture_plans.devices.interfaces import DeviceError
from realsim_capture_plans.planning.record import CapturePlan

Array = NDArray[np.float64]


class NoWayError(DeviceError):
    """Nothing of the plan can be reached freely from where the arm stands."""


class Route:
    """The corners of a plan's tour, and the way from any of them, or from anywhere, to a view."""

    def __init__(self, plan: CapturePlan) -> None:
        """List the corners: home, via points, views."""
        self._plan = plan
        corners, at_view = [plan.home], list[int]()
        for k in range(len(plan)):
            corners.extend(plan.move(k)[1:])
            at_view.append(len(corners) - 1)
        self._corners = np.stack(corners)
        self._at_view = at_view

    def along(self, place: int, k: int) -> list[Array]:
        """Return the joints to pass from view `place` to view k, along the tour either way."""
        start, goal = self._at_view[place], self._at_view[k]
        if start < goal:
            return list(self._corners[start + 1 : goal + 1])
        return list(self._corners[goal:start][::-1])

    def from_anywhere(self, here: Array, k: int) -> list[Array]:
        """Return the joints to pass from joints (6,) [rad] to view k.

        Straight to the view if that is free, else to the nearest corner of the tour that can be
        reached freely, and on along the tour.

        Raises:
            NoWayError: nothing of the tour can be reached freely.
        """
        plan, goal = self._plan, self._at_view[k]
        if np.array_equal(here, self._corners[goal]):
            return []
        model = plan.collision_model()
        stack, step = self._corners, plan.config.edge_step_rad
        if model.edges_free(here[None], stack[goal][None], step)[0]:
            return [stack[goal]]
        free = model.edges_free(np.broadcast_to(here, stack.shape), stack, step)
        if not np.any(free):
            raise NoWayError(
                f"from joints {np.round(here, 3).tolist()} rad no straight move to the plan is "
                f"free. Move the arm by hand to the plan's home {np.round(plan.home, 3).tolist()} "
                "rad."
            )
        nearest = int(np.argmin(np.where(free, np.abs(stack - here).max(-1), np.inf)))
        if nearest <= goal:
            return list(stack[nearest : goal + 1])
        return list(stack[goal : nearest + 1][::-1])
