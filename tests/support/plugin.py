"""Which arguments load the plugin here: none where the package was installed with it."""

from importlib.metadata import entry_points

PLUGIN: list[str] = (
    [] if any(e.name == "rt_runner" for e in entry_points(group="pytest11")) else ["-p", "rt_runner.pytest_plugin"]
)
