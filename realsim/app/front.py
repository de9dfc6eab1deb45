"""The table of commands: the help of `realsim` is answered from it, before any library loads."""

GROUPS = {
    "Prepare": {
        "demo": "Run the whole loop in a simulated lab",
        "doctor": "Say what this machine lacks, and how to get it",
        "robots": "Show the known arms and hands; check your own",
        "board": "Print a calibration target as a PDF at exact scale",
        "plan": "Plan the views of a scene, or of a board",
        "plan-show": "Show how good a plan is, and replay it",
        "plan-convert": "Convert plans from and to other programs",
    },
    "Capture": {
        "capture": "Drive a plan and store its views in a session",
        "import": "Turn a recording, images or a data set into a session",
        "check": "Verify every checksum; say what is damaged",
    },
    "Calibrate": {
        "calibrate": "Calibrate lens and hand-eye",
        "depth-fit": "Fit the depth camera's noise and holes",
    },
    "Register": {
        "scan": "Add meshes to a library of models, at metric scale",
        "register": "Find the pose of every object, with its uncertainty",
        "upgrade": "Refine a BOP or GraspNet data set and add grasps",
    },
    "Grasp": {
        "school": "Try grasps by physics: close, lift, shake, swing",
        "demonstrations": "Write grasps as a LeRobot v3.0 data set",
    },
    "Label": {
        "annotate": "Write masks, maps, poses and grasps for every frame",
        "render": "Render the twin of every frame, or new views",
        "generate": "Make tabletop scenes with every label",
    },
    "Review": {
        "review": "Accept, reject or correct objects in the browser",
        "report": "Report a session on a page, or compare several",
        "stats": "Count scenes, frames, grasps and scores",
    },
    "Share": {
        "export": "Write another format, with a card and checksums",
        "pipeline": "Run all stages over many scenes, from one file",
        "reproduce": "Make a result again and compare it",
        "config": "Show the settings in force; print a template",
        "completion": "Print the shell's completion script",
    },
}
"""What each command does, by its group, in the order of the work."""
ELSEWHERE = {"import": "importing.cli", "plan-show": "plan.cli", "plan-convert": "plan.cli",
             "completion": "completion"}  # fmt: skip
"""Modules of commands that are not in the folder of their name."""
COMMANDS = {
    name: f"realsim.app.{ELSEWHERE.get(name, f'{key}.cli')}:{key}_command"
    for group in GROUPS.values() for name, key in ((n, n.replace("-", "_")) for n in group)
}  # fmt: skip
"""Where each command is defined; it is imported only when it is asked for."""
HELP = """\
Usage: realsim [OPTIONS] COMMAND [ARGS]...

  Turn robot captures into grasping data that you can trust.

  Start with `realsim demo`: the whole loop in a simulated lab, no hardware
  needed. Run a command again and it continues where it stopped.
"""
OPTIONS = """
Options:
  --config FILE   Settings (TOML).  [REALSIM_CONFIG, realsim.toml,
                  ~/.config/realsim/config.toml]
  --no-color      Use no colours; NO_COLOR=1 does the same.
  --version       Show the version and exit.
  -h, --help      Show this message and exit.

Exit codes: 0 done, 1 done but a check failed, 2 bad input, 130 interrupted.

Examples:
  realsim demo
  realsim doctor
  realsim register --help
"""


def help_text() -> str:
    """Return the help of `realsim`, its commands by group."""
    parts = [HELP]
    for title, group in GROUPS.items():
        lines = [f"  {name:15} {does}.\n" for name, does in group.items()]
        parts.append(f"\n{title}:\n{''.join(lines)}")
    return "".join([*parts, OPTIONS])
