"""The one picture of a plan, under its first address; `plan_pictures` is where it is drawn."""

from realsim_capture_plans.pictures.plan_pictures import plan_picture

__all__ = ["plan_picture"]
