"""Arms and hands as data: a folder with a `robot.toml`, and what everybody reads out of it."""
