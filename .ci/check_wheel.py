"""Build the wheel and the sdist, and prove that the wheel stands alone.

Checks: exactly four top-level names; a fresh environment installs it, imports all four packages and
the libraries that need a preload, and runs the smallest demo.
"""

import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

EXPECTED = {"realsim", "realsim_calibration", "realsim_capture_plans", "realsim_sim_bridge"}
PROBE = """
import importlib, importlib.util
for name in {names}:
    importlib.import_module(name)
for generic in ("calibration", "capture_plans", "sim_bridge", "tests"):
    assert importlib.util.find_spec(generic) is None, generic
from importlib.resources import files
assert (files("realsim.pages") / "page.html").is_file()
from realsim.interop import import_open3d, import_pinocchio, import_pyrealsense2
import_open3d(); import_pinocchio(); import_pyrealsense2()
from realsim_capture_plans.plan_files.plan_json import shipped_plan
assert len(shipped_plan("ur5_d405_hemisphere_256")) == 256
print("isolated install works")
"""


def main() -> None:
    """Build, look inside, install elsewhere, run."""
    root = Path(__file__).resolve().parent.parent
    with tempfile.TemporaryDirectory() as temporary:
        out = Path(temporary)
        subprocess.run(["uv", "build", "-q", "--out-dir", str(out / "dist")], cwd=root, check=True)
        wheel = next((out / "dist").glob("*.whl"))
        names = {n.split("/")[0] for n in zipfile.ZipFile(wheel).namelist()}
        top = {n for n in names if not n.endswith(".dist-info")}
        if top != EXPECTED:
            sys.exit(f"the wheel's top-level names are {sorted(top)}, not {sorted(EXPECTED)}")
        python = out / "env/bin/python"
        subprocess.run(["uv", "venv", "-q", "--python", "3.11", str(out / "env")], check=True)
        subprocess.run(
            ["uv", "pip", "install", "-q", "--python", str(python), str(wheel)], check=True
        )
        code = PROBE.format(names=sorted(EXPECTED))
        subprocess.run([str(python), "-c", code], cwd=out, check=True)
        demo = [str(out / "env/bin/realsim"), "demo", "--quiet"]
        small = ["--views", "4", "--objects", "1", "--grasps", "2", "--workers", "1"]
        subprocess.run([*demo, *small], cwd=out, check=True, stdout=subprocess.DEVNULL)
    print(f"{wheel.name}: {', '.join(sorted(top))}")


if __name__ == "__main__":
    main()
