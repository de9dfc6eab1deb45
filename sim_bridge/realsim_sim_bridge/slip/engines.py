"""The engines by name."""

from realsim.errors import InputError
from realsim_sim_bridge.slip.bullet_settings import BulletSettings
from realsim_sim_bridge.slip.mujoco_settings import MujocoSettings
from realsim_sim_bridge.slip.world import Engine

ENGINES = ("pybullet", "mujoco")


def make_engine(settings: BulletSettings | MujocoSettings) -> Engine:
    """Return the engine that the settings are of.

    Raises:
        InputError: MuJoCo is asked for and not installed.
    """
    if isinstance(settings, BulletSettings):
        from realsim_sim_bridge.slip.bullet_world import BulletEngine

        return BulletEngine(settings)
    try:
        import mujoco  # noqa: F401  # pyright: ignore[reportUnusedImport]
    except ImportError:
        raise InputError(
            "MuJoCo is not installed; it is the Robot School's second engine. Install it with "
            "`uv sync --extra mujoco` or `pip install 'realsim[mujoco]'`, or use the engine "
            "pybullet."
        ) from None
    from realsim_sim_bridge.slip.mujoco_world import MujocoEngine

    return MujocoEngine(settings)


def settings_of(name: str, *, reference: bool = False) -> BulletSettings | MujocoSettings:
    """Return an engine's settings by its name.

    Args:
        name: 'pybullet' or 'mujoco'.
        reference: the slow ones that the fast ones are judged by.

    Raises:
        InputError: no engine of that name.
    """
    if name == "pybullet":
        return BulletSettings.reference() if reference else BulletSettings()
    if name == "mujoco":
        return MujocoSettings.reference() if reference else MujocoSettings()
    raise InputError(f"there is no engine '{name}'; there are: {', '.join(ENGINES)}.")
